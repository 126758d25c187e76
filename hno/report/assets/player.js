/** Plays one episode: views from above and, in space, from the side, and the distance over time. */
const player = { frame: 0, fresh: true, clock: 0, playing: false, episode: null, views: [] };

async function show() {
  const episode = DATA.episodes[$("episode").value];
  if (!episode) return;
  player.episode = episode;
  const solid = "side" in episode.whole;
  $("side").hidden = !solid;
  $("top").parentElement.classList.toggle("two", solid);
  $("scrub").max = episode.frames.length - 1;
  $("said").replaceChildren(
    element("span", { className: `tag ${episode.collided ? "bad" : "ok"}`, textContent: episode.collided ? "collision" : "safe" }),
    ` ${episode.said}`,
  );
  player.frame = player.fresh ? episode.closest : Math.min(player.frame, episode.frames.length - 1);
  player.views = [];
  const scenes = Object.entries(episode.whole).map(([name, whole]) => scene(episode, name, whole, solid));
  const made = await Promise.all([...scenes, apart(episode), believed(episode)]);
  if (player.episode !== episode) return;
  player.views = made.filter(Boolean);
  seek(player.frame);
}

function scene({ frames }, name, whole, solid) {
  const width = Math.max(200, $(name).clientWidth - 52);
  const needed = (width * (whole.top - whole.bottom)) / (whole.right - whole.left);
  const height = solid ? Math.min(width * 0.66, 340) : Math.max(Math.min(width * 0.42, 260), Math.min(needed, 360));
  return draw($(name), name, { frames }, { width, height, frame: player.frame, follow: $("follow").checked, ...whole });
}

function apart({ frames }) {
  $("apart").hidden = frames[0].distance === null;
  return $("apart").hidden ? null : draw($("apart"), "separation", { frames }, { frame: player.frame });
}

function believed({ frames }) {
  $("believed").hidden = !frames[0].mean;
  return $("believed").hidden ? null : draw($("believed"), "beliefs", { frames }, { frame: player.frame });
}

function seek(frame) {
  player.frame = frame;
  const { t, branch } = player.episode.frames[frame];
  const clock = `${t.toFixed(2)} s${branch === null ? "" : `, branch ${branch}`}`;
  $("scrub").value = frame;
  $("scrub").setAttribute("aria-valuetext", clock);
  $("clock").textContent = clock;
  for (const view of player.views) {
    if ("follow" in view.getState().signals) view.signal("follow", $("follow").checked);
    view.signal("frame", frame).run();
  }
}

function play(on) {
  player.playing = on;
  $("play").textContent = on ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", on ? "Pause" : "Play");
  if (!on) return;
  const { frames } = player.episode;
  if (player.fresh || player.frame >= frames.length - 1) seek(0);
  player.fresh = false;
  player.clock = frames[player.frame].t;
  let last = performance.now();
  requestAnimationFrame(function tick(now) {
    if (!player.playing) return;
    player.clock += (Number($("speed").value) * (now - last)) / 1000;
    last = now;
    let frame = player.frame;
    while (frame < frames.length - 1 && frames[frame + 1].t <= player.clock) frame += 1;
    if (frame !== player.frame) seek(frame);
    if (frame >= frames.length - 1) play(false);
    else requestAnimationFrame(tick);
  });
}

/** Lists the episodes that match the filters. */
function list() {
  const select = $("episode");
  const before = select.value;
  const left = [...DATA.episodes.keys()].filter((k) => matches(DATA.episodes[k]));
  select.replaceChildren(
    ...left.map((k) => element("option", { value: k, textContent: DATA.episodes[k].title })),
  );
  if (before && left.includes(Number(before))) select.value = before;
  $("player").hidden = !left.length;
  if (left.length && select.value !== before) pick();
}

/** A newly chosen episode stands at its closest approach; playing begins at its start. */
function pick() {
  player.fresh = true;
  show();
}

function turn(by) {
  const select = $("episode");
  select.selectedIndex = (select.selectedIndex + by + select.length) % select.length;
  play(false);
  pick();
}

if ($("player")) {
  $("play").addEventListener("click", () => play(!player.playing));
  $("scrub").addEventListener("input", () => {
    play(false);
    player.fresh = false;
    seek(Number($("scrub").value));
  });
  $("episode").addEventListener("change", () => {
    play(false);
    pick();
  });
  $("previous").addEventListener("click", () => turn(-1));
  $("next").addEventListener("click", () => turn(1));
  $("follow").addEventListener("change", () => seek(player.frame));
  listeners.push(list);
  const again = () => player.episode && !$("player").hidden && show();
  dark.addEventListener("change", again);
  addEventListener("resize", () => setTimeout(again, 200));
  addEventListener("beforeprint", again);
  addEventListener("afterprint", again);
}
