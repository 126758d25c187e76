/** Plays one episode: views from above and, in space, from the side, and the distance over time. */
const player = { frame: 0, fresh: true, clock: 0, playing: false, episode: null, views: [] };

/** Undoes the differences in which a series is written. */
function series(differences, scale) {
  let total = 0;
  return differences.map((difference) => (total += difference) / scale);
}

function unpack(packed) {
  const axes = (paths) => paths.map((path) => path.map((values) => series(values, 100)));
  return {
    ...packed, t: series(packed.t, 1000), radius: series(packed.radius, 1000), gap: series(packed.gap, 1000),
    positions: axes(packed.positions), ghost: packed.ghost && axes(packed.ghost),
  };
}

const rowsOf = (episode, paths, up) =>
  paths.flatMap((path, who) =>
    episode.t.map((_, frame) => ({
      frame, player: who + 1, x: path[0][frame], y: path[up][frame], radius: episode.radius[frame], gap: episode.gap[frame],
    })),
  );

function extent(episode, up) {
  const shown = [...episode.positions, ...(episode.ghost ?? [])];
  const margin = 0.7 * Math.max(...episode.radius);
  const range = (axis) => {
    const values = shown.flatMap((path) => path[axis]);
    return [Math.min(...values) - margin, Math.max(...values) + margin];
  };
  return { x: range(0), y: range(up) };
}

/** The part of space that a view shows: all of it, or what surrounds the players, in true proportion. */
function camera(episode, up, frame, wide, high, whole) {
  let centre = [(whole.x[0] + whole.x[1]) / 2, (whole.y[0] + whole.y[1]) / 2];
  let scale = Math.min(wide / (whole.x[1] - whole.x[0]), high / (whole.y[1] - whole.y[0]));
  if ($("follow").checked) {
    const at = (axis) => episode.positions.map((path) => path[axis][frame]);
    const [xs, ys] = [at(0), at(up)];
    const middle = (values) => (Math.min(...values) + Math.max(...values)) / 2;
    const span = (values) => Math.max(...values) - Math.min(...values) + 2.4 * episode.radius[frame];
    const close = Math.min(wide / span(xs), high / span(ys), high / (3.2 * episode.radius[frame]));
    if (close > scale) [scale, centre] = [close, [middle(xs), middle(ys)]];
  }
  const [half, tall] = [wide / scale / 2, high / scale / 2];
  return { left: centre[0] - half, right: centre[0] + half, bottom: centre[1] - tall, top: centre[1] + tall };
}

async function show() {
  const picked = DATA.episodes[$("episode").value];
  if (!picked) return;
  const episode = (player.episode = unpack(picked));
  const solid = episode.positions[0].length === 3;
  $("side").hidden = !solid;
  $("top").parentElement.classList.toggle("two", solid);
  $("scrub").max = episode.t.length - 1;
  describe(episode);
  player.frame = player.fresh ? episode.gap.indexOf(Math.min(...episode.gap)) : Math.min(player.frame, episode.t.length - 1);
  player.views = [];
  const scenes = [["top", 1], ...(solid ? [["side", 2]] : [])].map(([name, up]) => scene(episode, name, up));
  const made = await Promise.all([...scenes, apart(episode)]);
  if (player.episode !== episode) return;
  player.views = made;
  seek(player.frame);
}

async function scene(episode, name, up) {
  const host = $(name);
  const wide = Math.max(200, host.clientWidth - 52);
  const whole = extent(episode, up);
  const needed = (wide * (whole.y[1] - whole.y[0])) / (whole.x[1] - whole.x[0]);
  const solid = episode.positions[0].length === 3;
  const high = solid ? Math.min(wide * 0.66, 340) : Math.max(Math.min(wide * 0.42, 260), Math.min(needed, 360));
  const data = {
    path: rowsOf(episode, episode.positions, up),
    ghost: episode.ghost ? rowsOf(episode, episode.ghost, up) : [],
  };
  const start = camera(episode, up, player.frame, wide, high, whole);
  const view = await draw(host, name, data, { width: wide, height: high, frame: player.frame, ...start });
  return (frame) => {
    if (!view) return;
    for (const [signal, value] of Object.entries(camera(episode, up, frame, wide, high, whole))) view.signal(signal, value);
    view.signal("frame", frame).run();
  };
}

async function apart(episode) {
  const rows = episode.t.map((t, frame) => ({
    frame, t, radius: episode.radius[frame], distance: episode.radius[frame] + episode.gap[frame],
  }));
  const reach = Math.min(Math.max(...rows.map((row) => row.distance)), 6 * Math.max(...episode.radius));
  const view = await draw($("apart"), "separation", { distances: rows }, { frame: player.frame, reach });
  return (frame) => view?.signal("frame", frame).run();
}

function describe(episode) {
  const between = episode.collided && Math.min(...episode.gap) >= 0 ? " (between the frames shown)" : "";
  const cost = episode.cost === null ? "n/a" : episode.cost.toFixed(1);
  const label = episode.label_cost === null ? "n/a" : episode.label_cost.toFixed(1);
  const closest = episode.clearance === null ? "clearance n/a"
    : `comes ${Math.abs(episode.clearance).toFixed(2)} m ${episode.clearance > 0 ? "short of" : "inside"} the collision radius`;
  $("said").replaceChildren(
    element("span", { className: `tag ${episode.collided ? "bad" : "ok"}`, textContent: episode.collided ? "collision" : "safe" }),
    ` ${episode.run}, types ${types(episode.theta)}, ${episode.kind}: ${closest}${between}. Joint cost ${cost}, the equilibrium's ${label}.`,
  );
}

function seek(frame) {
  player.frame = frame;
  const { t } = player.episode;
  $("scrub").value = frame;
  $("scrub").setAttribute("aria-valuetext", `${t[frame].toFixed(2)} s`);
  $("clock").textContent = `${t[frame].toFixed(2)} s`;
  for (const update of player.views) update(frame);
}

function play(on) {
  player.playing = on;
  $("play").textContent = on ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", on ? "Pause" : "Play");
  if (!on) return;
  const { t } = player.episode;
  if (player.fresh || player.frame >= t.length - 1) seek(0);
  player.fresh = false;
  player.clock = t[player.frame];
  let last = performance.now();
  requestAnimationFrame(function tick(now) {
    if (!player.playing) return;
    player.clock += (Number($("speed").value) * (now - last)) / 1000;
    last = now;
    let frame = player.frame;
    while (frame < t.length - 1 && t[frame + 1] <= player.clock) frame += 1;
    if (frame !== player.frame) seek(frame);
    if (frame >= t.length - 1) play(false);
    else requestAnimationFrame(tick);
  });
}

/** Lists the episodes that match the filters. */
function list() {
  const select = $("episode");
  const before = select.value;
  const left = [...DATA.episodes.keys()].filter((k) => matches(DATA.episodes[k]));
  select.replaceChildren(
    ...left.map((k) => {
      const { run, theta, kind, collided } = DATA.episodes[k];
      return element("option", { value: k, textContent: `${run} · ${types(theta)} · ${kind}${collided ? " · collision" : ""}` });
    }),
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
