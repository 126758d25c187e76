/** Plays one episode, perhaps with another policy's beside it: views, and numbers over time below them. */
const player = { time: 0, fresh: true, playing: false, seen: false, turn: 0, episode: null, beside: null, views: [], strips: [], type: "" };
const nameOf = (episode) => [episode.run, episode.theta.join(","), episode.kind].join("|");
const typeOf = (episode) => `(${episode.theta.join(", ")})`;
const titleOf = (episode) => [episode.run, typeOf(episode), episode.kind, ...(episode.collided ? ["collision"] : []), ...(episode.other_side ? ["other side"] : [])].join(" · ");
const ended = () => player.episode.t.at(-1);

function makeViews(episode) {
  const solid = episode.p[0][0].length === 3;
  for (const kind of ["space", "side"]) $(kind).hidden = !solid;
  $("turned").hidden = !solid;
  $("top").parentElement.classList.toggle("solid", solid);
  player.views = (solid ? ["top", "side", "space"] : ["top"]).map((kind) => {
    const canvas = $(kind).querySelector("canvas") ?? $(kind).appendChild(element("canvas"));
    return { kind, canvas, turn: Number($("turn").value) };
  });
}

/** Who is who, in the colours of the picture. */
function legend(episode, scene) {
  const colors = category();
  const names = episode.p[0].map((_, k) => scene.players?.[k] ?? `player ${k + 1}`);
  const keys = names.map((name, k) => {
    const swatch = element("i", { className: "swatch who" });
    swatch.style.background = colors[k % colors.length];
    return element("span", {}, swatch, `${k + 1}: ${name}, θ = ${episode.theta[k]}`);
  });
  const more = [["dash", "equilibrium from the same start", episode.ghost], ["dots", player.beside?.run, player.beside]];
  keys.push(...more.filter((entry) => entry[2]).map(([kind, name]) => element("span", {}, element("i", { className: kind }), name)));
  $("who").replaceChildren(...keys);
  $("drawn").textContent = scene.note ?? "";
}

const series = (of, name, k) =>
  of.flatMap((episode, beside) =>
    (episode[name] ?? []).flatMap((row, frame) =>
      row.map((value, player) => ({ t: episode.t[frame], player: player + 1, y: k === undefined ? value : value[k], beside: beside > 0 })),
    ),
  );

/** Charts over time: what is drawn, its data and its heading. */
function strips(episode, scene) {
  const of = player.beside ? [episode, player.beside] : [episode];
  const frames = episode.t.map((t, frame) => ({
    frame, t, distance: episode.distance?.[frame] ?? null, radius: episode.radius?.[frame] ?? null,
    mean: episode.mean?.[frame], low: episode.low?.[frame], high: episode.high?.[frame], type: episode.theta,
  }));
  const found = [];
  if (episode.distance) found.push(["separation", { frames }, "Distance between the players over time"]);
  if (episode.mean) found.push(["beliefs", { frames }, "What the others believe of each player's type over time"]);
  const rows = [["v", undefined, "speed [m/s]"], ["value", undefined, "value of the rest, as the policy sees it"]];
  const controls = episode.u?.[0]?.[0]?.length ?? 0;
  for (let k = 0; k < controls; k += 1) rows.push(["u", k, scene.controls?.[k] ?? `control ${k + 1}`]);
  for (const [name, k, heading] of rows)
    if (episode[name]) found.push(["strip", { series: series(of, name, k) }, heading]);
  return found;
}

async function drawStrips(episode, scene) {
  const wanted = strips(episode, scene);
  const hosts = wanted.map(([, , name]) => {
    const plot = element("div", { className: "plot" });
    const host = element("div", { className: "strip" }, plot, element("canvas", { className: "now" }));
    host.setAttribute("role", "img");
    host.setAttribute("aria-label", `${name}, by player`);
    return host;
  });
  $("strips").replaceChildren(...hosts);
  const made = await Promise.all(
    wanted.map(([chart, data, heading], k) => draw(hosts[k].firstChild, chart, data, { heading, height: 90 })),
  );
  if (player.episode !== episode) return;
  player.strips = made.map((view, k) => ({ view, host: hosts[k] })).filter(({ view }) => view);
  seek(player.time);
}

/** An episode of the list with what its run's part holds of it. */
const whole = async (one) => one && { ...one, ...(await part(one.of)).episodes[one.place] };

/** Loads what is chosen, and draws it once the player is seen. */
async function show() {
  const turn = ++player.turn;
  const chosen = [$("episode"), $("beside")].map((select) => DATA.episodes[select.value]);
  if (!chosen[0]) return;
  const found = await Promise.all(chosen.map(whole)).catch((error) => error);
  if (turn !== player.turn) return;
  const lost = found instanceof Error;
  $("player").toggleAttribute("data-lost", lost);
  if (lost) $("said").textContent = found.message;
  [player.episode, player.beside = null] = lost ? [null] : found;
  player.views = [];
  if (player.seen && !lost) drawEpisode();
}

function drawEpisode() {
  const { episode, beside } = player;
  const scene = DATA.scenes[episode.game] ?? {};
  $("said").replaceChildren(
    element("span", { className: `tag ${episode.collided ? "bad" : "ok"}`, textContent: episode.collided ? "collision" : "safe" }),
    ` ${episode.said}`,
    ...(beside ? [element("br"), `Beside it: ${beside.said}`] : []),
  );
  makeViews(episode);
  legend(episode, scene);
  $("scrub").max = ended();
  player.strips = [];
  seek(player.fresh ? episode.t[episode.closest] : Math.min(player.time, ended()));
  drawStrips(episode, scene);
}

/** Moves to a time, s; between frames places are interpolated. */
function seek(time) {
  if (!player.views.length) return;
  player.time = Math.max(0, Math.min(time, ended()));
  const { episode, beside } = player;
  const branch = episode.branch?.[place(episode.t, player.time + 1e-9).low];
  const clock = `${player.time.toFixed(2)} s${branch === undefined ? "" : `, branch ${branch}`}`;
  const moment = { episode, beside, scene: DATA.scenes[episode.game] ?? {}, time: player.time, follow: $("follow").checked };
  known.clear();
  for (const view of player.views) paint(view, moment); // before anything changes: it asks for the size of the canvas
  for (const strip of player.strips) mark(strip, player.time);
  $("scrub").value = player.time;
  $("scrub").setAttribute("aria-valuetext", clock);
  $("clock").textContent = clock;
}

function play(on) {
  player.playing = on;
  $("play").textContent = on ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", on ? "Pause" : "Play");
  if (!on || !player.views.length) return;
  if (player.fresh || player.time >= ended()) seek(0);
  player.fresh = false;
  let last = performance.now();
  requestAnimationFrame(function tick(now) {
    if (!player.playing) return;
    seek(player.time + (Number($("speed").value) * Math.max(0, now - last)) / 1000);
    last = now;
    if (player.time >= ended()) play(false);
    else requestAnimationFrame(tick);
  });
}

/** Lists the episodes that match the filters, the chosen types and, from a heat map, its runs. */
function list(wanted) {
  const select = $("episode");
  const before = wanted ?? select.value;
  const left = [...DATA.episodes.keys()].filter((k) => {
    const one = DATA.episodes[k];
    return matches(one) && (!player.type || typeOf(one) === player.type) && (!player.runs || player.runs.includes(one.run));
  });
  if (player.listed !== String(left)) select.replaceChildren(...left.map((k) => element("option", { value: k, textContent: titleOf(DATA.episodes[k]) })));
  player.listed = String(left);
  if (before !== "" && left.includes(Number(before))) select.value = before;
  $("player").hidden = !left.length;
  $("none").hidden = Boolean(left.length);
  if (left.length && (select.value !== before || wanted !== undefined)) pick();
}

/** Episodes of other runs from the same start state. */
function listBeside() {
  const chosen = DATA.episodes[$("episode").value];
  const same = [...DATA.episodes.keys()].filter((k) => {
    const other = DATA.episodes[k];
    return chosen.start && other.start === chosen.start && other.game === chosen.game && other.run !== chosen.run;
  });
  const options = same.map((k) => element("option", { value: k, textContent: DATA.episodes[k].run }));
  $("beside").replaceChildren(element("option", { value: "", textContent: "nothing" }), ...options);
  $("beside").parentElement.hidden = !same.length;
}

/** A newly chosen episode stands at its closest approach; playing begins at its start. */
function pick() {
  player.fresh = true;
  listBeside();
  show();
  remember({ episode: nameOf(DATA.episodes[$("episode").value]), beside: "", t: "" });
}

function turn(by) {
  const select = $("episode");
  select.selectedIndex = (select.selectedIndex + by + select.length) % select.length;
  play(false);
  pick();
}

/** What is listed: all types or one, of all runs or of those of a heat map. */
function choose_type(type, runs = null) {
  Object.assign(player, { type, runs });
  $("types").value = type;
  $("ofmap").hidden = !runs;
  $("none").textContent = `No episode${type ? ` at θ = ${type}` : ""} of what is chosen is in this page.`;
  list();
  remember({ type });
}

/** Shows the episode that the address names, at its time. */
function recall() {
  const { type = "", episode, beside, t } = remembered();
  const known = [...$("types").options].some((option) => option.value === type) ? type : "";
  Object.assign(player, { type: known, runs: null });
  $("types").value = known;
  const find = (name) => DATA.episodes.findIndex((one) => nameOf(one) === name);
  const found = episode ? find(episode) : -1;
  list(found < 0 ? undefined : String(found));
  if (found < 0 || $("episode").value !== String(found)) return;
  const other = beside ? find(beside) : -1;
  if (other >= 0) $("beside").value = String(other);
  if (other >= 0) show();
  if (t) {
    Object.assign(player, { fresh: false, time: Number(t) || 0 });
    show();
  }
  remember({ episode, beside: other >= 0 ? beside : "", t: t ?? "" });
}

if ($("player")) {
  for (const one of DATA.episodes) Object.assign(one, DATA.runs[one.of]);
  const types = [...new Set(DATA.episodes.map(typeOf))].sort((a, b) => a.localeCompare(b, "en", { numeric: true }));
  $("types").append(...types.map((type) => element("option", { value: type, textContent: type })));
  $("play").addEventListener("click", () => play(!player.playing));
  $("scrub").addEventListener("input", () => {
    play(false);
    player.fresh = false;
    seek(Number($("scrub").value));
    remember({ t: player.time.toFixed(2) });
  });
  const changed = (then) => () => {
    play(false);
    then();
  };
  $("episode").addEventListener("change", changed(pick));
  $("types").addEventListener("change", changed(() => choose_type($("types").value)));
  $("ofmap").addEventListener("click", () => choose_type("", null));
  $("beside").addEventListener("change", () => {
    show();
    const beside = DATA.episodes[$("beside").value];
    remember({ beside: beside ? nameOf(beside) : "" });
  });
  $("previous").addEventListener("click", () => turn(-1));
  $("next").addEventListener("click", () => turn(1));
  $("follow").addEventListener("change", () => seek(player.time));
  const rotate = () => {
    for (const view of player.views) view.turn = Number($("turn").value);
    seek(player.time);
  };
  $("turn").addEventListener("input", rotate);
  $("space").addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    $("turn").value = Number($("turn").value) + event.movementX / 120;
    rotate();
  });
  listeners.push(() => list());
  const again = () => player.seen && player.episode && !$("player").hidden && drawEpisode();
  dark.addEventListener("change", again);
  addEventListener("resize", () => setTimeout(again, 200));
  addEventListener("beforeprint", again);
  addEventListener("afterprint", again);
  whenSeen($("episodes"), () => {
    player.seen = true;
    again();
  });
  recallers.push(recall);
}
readAddress();
