/** Draws an episode at any moment into a canvas: from above, from the side, or in space. Lengths are to scale. */
const known = new Map(); // until the next picture
function color(name) {
  if (!known.has(name)) known.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return known.get(name);
}
const category = () => theme().config.range.category;
const mix = (a, b, share) => a.map((value, k) => value + share * (b[k] - value));

/** The frame before a time, and the share of the way to the next one. */
function place(t, time) {
  let low = 0;
  let high = t.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (t[middle] <= time) low = middle;
    else high = middle;
  }
  const next = Math.min(low + 1, t.length - 1);
  const span = t[next] - t[low];
  return { low, next, share: span > 0 ? Math.max(0, Math.min(1, (time - t[low]) / span)) : 0 };
}

const at = (t, rows, time) => {
  const { low, next, share } = place(t, time);
  return rows[low].map((row, player) => mix(row, rows[next][player], share));
};

/** Angle of a path seen from above. */
function heading(t, rows, time, player) {
  const { low, next } = place(t, time);
  const [from, to] = next > low ? [low, next] : [Math.max(0, low - 1), low];
  return Math.atan2(rows[to][player][1] - rows[from][player][1], rows[to][player][0] - rows[from][player][0]);
}

/** Places on the plane of a view: [right, up], m. */
function flatten(view, point) {
  const [x, y, z = 0] = point;
  if (view.kind === "top") return [x, y];
  if (view.kind === "side") return [x, z];
  const [c, s, tilt] = [Math.cos(view.turn), Math.sin(view.turn), 0.45];
  return [x * c - y * s, (x * s + y * c) * Math.sin(tilt) + z * Math.cos(tilt)];
}

function extent(view, points, room) {
  const flat = points.map((point) => flatten(view, point));
  const [xs, ys] = [0, 1].map((axis) => flat.map((point) => point[axis]));
  return [Math.min(...xs) - room, Math.max(...xs) + room, Math.min(...ys) - room, Math.max(...ys) + room];
}

/** Fits what is to be seen into the canvas, with the same scale along both axes. */
function fit(view, [left, right, bottom, top], width, height, margin) {
  const scale = Math.min((width - 2 * margin) / (right - left), (height - 2 * margin) / (top - bottom));
  const [x, y] = [(left + right) / 2, (bottom + top) / 2];
  view.scale = scale;
  view.px = (point) => {
    const [a, b] = flatten(view, point);
    return [width / 2 + (a - x) * scale, height / 2 - (b - y) * scale];
  };
  view.shown = [x - width / 2 / scale, x + width / 2 / scale, y - height / 2 / scale, y + height / 2 / scale];
}

function line(ctx, points, style = {}) {
  ctx.save();
  Object.assign(ctx, style);
  ctx.setLineDash(style.dash ?? []);
  ctx.beginPath();
  points.forEach(([x, y], k) => (k ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.stroke();
  ctx.restore();
}

function write(ctx, text, x, y, style = {}) {
  ctx.save();
  Object.assign(ctx, { font: `11px ${color("font")}`, fillStyle: color("muted"), ...style });
  ctx.fillText(text, x, y);
  ctx.restore();
}

function roads(ctx, view, scene, width, height) {
  if (view.kind !== "top") return;
  for (const { axis, edges, marks } of scene.roads ?? []) {
    const across = (value) => view.px(axis ? [value, 0] : [0, value])[axis ? 0 : 1];
    const strip = (value) => (axis ? [[across(value), 0], [across(value), height]] : [[0, across(value)], [width, across(value)]]);
    const [a, b] = edges.map(across).sort((one, other) => one - other);
    ctx.fillStyle = color("line");
    ctx.globalAlpha = 0.45;
    if (axis) ctx.fillRect(a, 0, b - a, height);
    else ctx.fillRect(0, a, width, b - a);
    ctx.globalAlpha = 1;
    for (const edge of edges) line(ctx, strip(edge), { strokeStyle: color("muted"), lineWidth: 1.2 });
    for (const mark of marks) line(ctx, strip(mark), { strokeStyle: color("muted"), lineWidth: 1.2, dash: [10, 8] });
  }
}

/** Round distances for a ruler: 1, 2 or 5 times a power of ten. */
function round(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return power * [1, 2, 5, 10].find((step) => step * power >= length);
}

function ruler(ctx, view, width, height) {
  const axes = { top: ["x [m]", "y [m]"], side: ["x [m]", "z [m]"] }[view.kind];
  const step = round(60 / view.scale);
  if (!axes) {
    const tick = step * view.scale;
    line(ctx, [[12, height - 10], [12 + tick, height - 10]], { strokeStyle: color("muted"), lineWidth: 2 });
    write(ctx, `${step} m`, 16 + tick, height - 6);
    return;
  }
  const [left, right, bottom, top] = view.shown;
  for (let x = Math.ceil(left / step) * step; x < right; x += step) {
    const at = (x - left) * view.scale;
    line(ctx, [[at, height], [at, height - 4]], { strokeStyle: color("muted") });
    if (at > 40 && at < width - 56) write(ctx, `${+x.toPrecision(6)}`, at, height - 7, { textAlign: "center" });
  }
  for (let y = Math.ceil(bottom / step) * step; y < top; y += step) {
    const at = height - (y - bottom) * view.scale;
    line(ctx, [[0, at], [4, at]], { strokeStyle: color("muted") });
    if (at > 24 && at < height - 24) write(ctx, `${+y.toPrecision(6)}`, 7, at + 4);
  }
  write(ctx, axes[0], width - 6, height - 7, { textAlign: "right" });
  write(ctx, axes[1], 7, 13);
}

/** In space: a floor below everything, and a plumb line from every player. */
function floor(ctx, view, box, places, colors) {
  const [x0, x1, y0, y1, z] = box;
  const step = round(Math.max(x1 - x0, y1 - y0) / 6);
  const style = { strokeStyle: color("line"), lineWidth: 1 };
  for (let x = Math.floor(x0 / step) * step; x <= x1 + step / 2; x += step) line(ctx, [[x, y0, z], [x, y1, z]].map(view.px), style);
  for (let y = Math.floor(y0 / step) * step; y <= y1 + step / 2; y += step) line(ctx, [[x0, y, z], [x1, y, z]].map(view.px), style);
  places.forEach((point, k) =>
    line(ctx, [point, [point[0], point[1], z]].map(view.px), { strokeStyle: colors[k % colors.length], dash: [2, 3] }),
  );
  write(ctx, "x", ...view.px([x1 + step / 3, y0, z]));
  write(ctx, "y", ...view.px([x0, y1 + step / 3, z]));
}

function body(ctx, view, point, size, angle, style) {
  const [x, y] = view.px(point);
  ctx.save();
  Object.assign(ctx, style);
  ctx.setLineDash(style.dash ?? []);
  ctx.translate(x, y);
  ctx.beginPath();
  if (size && view.kind === "top") {
    ctx.rotate(-angle);
    const [length, width] = size.map((side) => side * view.scale);
    ctx.roundRect(-length / 2, -width / 2, length, width, Math.min(4, width / 4));
  } else ctx.arc(0, 0, 5, 0, 2 * Math.PI);
  if (style.fillStyle) ctx.fill();
  ctx.stroke();
  if (size && view.kind === "top" && style.fillStyle) {
    ctx.fillStyle = color("surface");
    ctx.globalAlpha = 0.75;
    const [length, width] = size.map((side) => side * view.scale);
    ctx.fillRect(length * 0.12, -width * 0.36, length * 0.14, width * 0.72); // the windscreen: which way it faces
  }
  ctx.restore();
}

/** One policy's players: way so far, discs, bodies. The first is drawn in full, another one beside it as outlines. */
function players(ctx, view, episode, scene, time, beside) {
  const colors = category();
  const now = at(episode.t, episode.p, time);
  const { low, next, share } = place(episode.t, time);
  const lerp = (rows) => (rows ? rows[low] + share * (rows[next] - rows[low]) : null);
  const [radius, distance] = [lerp(episode.radius), lerp(episode.distance)];
  const struck = radius !== null && distance < radius;
  now.forEach((point, k) => {
    const own = struck ? color("danger") : colors[k % colors.length];
    const way = [...episode.p.slice(0, low + 1).map((row) => row[k]), point].map(view.px);
    line(ctx, way, { strokeStyle: colors[k % colors.length], lineWidth: 2.5, lineCap: "round", ...(beside ? { lineWidth: 1.5, dash: [2, 4] } : {}) });
    if (radius !== null && !beside) {
      ctx.beginPath();
      ctx.arc(...view.px(point), (radius / 2) * view.scale, 0, 2 * Math.PI);
      Object.assign(ctx, { fillStyle: own, strokeStyle: own, lineWidth: 1.2, globalAlpha: struck ? 0.4 : 0.16 });
      ctx.fill();
      ctx.globalAlpha = 1;
      ctx.stroke();
    }
    const angle = heading(episode.t, episode.p, time, k);
    const mine = colors[k % colors.length];
    const style = beside ? { strokeStyle: mine, lineWidth: 1.5, dash: [3, 2] } : { fillStyle: mine, strokeStyle: color("surface"), lineWidth: 1 };
    body(ctx, view, point, scene.bodies?.[k], angle, style);
    if (beside) return;
    const [x, y] = view.px(point);
    const lift = Math.max(10, ((radius ?? 0) / 2) * view.scale) + 6;
    write(ctx, String(k + 1), x, y - lift, { fillStyle: colors[k % colors.length], textAlign: "center", font: `600 13px ${color("font")}` });
  });
}

function ghosts(ctx, view, episode, scene, time) {
  if (!episode.ghost) return;
  const colors = category();
  at(episode.t, episode.ghost, time).forEach((point, k) => {
    const own = colors[k % colors.length];
    line(ctx, episode.ghost.map((row) => row[k]).map(view.px), { strokeStyle: own, lineWidth: 1.3, globalAlpha: 0.6, dash: [6, 4] });
    const angle = heading(episode.t, episode.ghost, time, k);
    body(ctx, view, point, scene.bodies?.[k], angle, { strokeStyle: own, lineWidth: 1.2, globalAlpha: 0.7 });
  });
}

/** Where another branch is played than a frame before: a diamond on the way. */
function changes(ctx, view, { branch, p, t }, time) {
  if (!branch) return;
  const colors = category();
  for (let k = 1; k < t.length && t[k] <= time; k += 1)
    if (branch[k] !== branch[k - 1])
      p[k].forEach((point, player) => {
        const [x, y] = view.px(point);
        ctx.fillStyle = colors[player % colors.length];
        ctx.beginPath();
        ctx.moveTo(x, y - 6);
        for (const [dx, dy] of [[6, 0], [0, 6], [-6, 0]]) ctx.lineTo(x + dx, y + dy);
        ctx.fill();
      });
}

/** What is in view: the surroundings of the players, or all that happens. */
function seen(view, episode, beside, time, follow) {
  const radius = Math.max(...(episode.radius ?? [1]));
  const all = [episode, ...(beside ? [beside] : [])].flatMap((one) => [...one.p, ...(one.ghost ?? [])]).flat();
  return follow ? extent(view, at(episode.t, episode.p, time), 2.2 * radius + 2) : extent(view, all, 0.7 * radius + 1);
}

/** An empty canvas, drawn on in pixels of the page. */
function cleared(canvas) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const ratio = devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio))
    Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return { ctx, width, height };
}

function paint(view, { episode, beside, scene, time, follow }) {
  const { ctx, width, height } = cleared(view.canvas);
  fit(view, seen(view, episode, beside, time, follow && view.kind !== "space"), width, height, 16);
  roads(ctx, view, scene, width, height);
  const now = at(episode.t, episode.p, time);
  if (view.kind === "space") {
    const all = [...episode.p, ...(episode.ghost ?? [])].flat();
    const ends = [0, 1].flatMap((axis) => [Math.min, Math.max].map((end) => end(...all.map((point) => point[axis]))));
    floor(ctx, view, [...ends, Math.min(...all.map((point) => point[2])) - 0.5], now, category());
  }
  ghosts(ctx, view, episode, scene, time);
  if (beside) players(ctx, view, beside, scene, Math.min(time, beside.t.at(-1)), true);
  players(ctx, view, episode, scene, time, false);
  changes(ctx, view, episode, time);
  ruler(ctx, view, width, height);
}

/** The moment in a chart over time. A canvas, since an element that moves costs all layers of the page. */
function mark({ view, host }, time) {
  const { ctx, height } = cleared(host.lastChild);
  const x = Math.round(view.origin()[0] + view.scale("x")(time) + view.padding().left) + 0.5;
  line(ctx, [[x, 0], [x, height]], { strokeStyle: color("ink"), dash: [3, 3] });
}
