readAddress();

/** While a sweep runs the page loads itself again, but not under somebody who is watching an episode. */
if (DATA.refresh) {
  let held = false;
  $("loaded").textContent = new Date().toLocaleTimeString();
  $("hold").addEventListener("click", () => {
    held = !held;
    $("hold").setAttribute("aria-pressed", String(held));
  });
  setInterval(() => held || player.playing || document.hidden || location.reload(), 1000 * DATA.refresh);
}
