// Top-down pictures of traffic on a canvas. World coordinates are metres with y up.

const TRAIL = 2.0; // s
const VERGE = 0.8; // m added to a lane's width, because the gap between neighbouring lanes is road, too
const BODY = [
  [1, 0.62],
  [0.9, 1],
  [-0.93, 1],
  [-1, 0.75],
  [-1, -0.75],
  [-0.93, -1],
  [0.9, -1],
  [1, -0.62],
];
const WINDSCREEN = [
  [0.52, 0.72],
  [0.2, 0.8],
  [0.2, -0.8],
  [0.52, -0.72],
]; // in units of half the length and width
const LAYERS = ["replayed", "traffic", "pedestrian", "cyclist", "adversary", "ego"]; // from the lowest to the highest
const GHOSTS = ["driver", "evasion", "recorded"]; // roles that are outlines
const COLOUR_OF = { pedestrian: "vulnerable", cyclist: "vulnerable" };

/** Paths of a decoded map, built once. */
function mapPaths({ lanes, drivable, widths }) {
  const surface = new Map(); // lanes of like width are one path
  const centrelines = new Path2D();
  lanes.forEach((line, index) => {
    const width = Math.round(10 * widths[index]) / 10;
    if (!surface.has(width)) surface.set(width, new Path2D());
    for (const path of [surface.get(width), centrelines]) trace(path, line);
  });
  const area = new Path2D();
  for (const ring of drivable) trace(area, ring, true);
  return { surface, centrelines, area };
}

function trace(path, line, closed = false) {
  line.forEach(([x, y], index) => (index ? path.lineTo(x, y) : path.moveTo(x, y)));
  if (closed) path.closePath();
}

/** Pose and speed of a track at a fractional step. */
function poseAt(track, time) {
  const low = Math.floor(time);
  const high = Math.min(low + 1, track.x.length - 1);
  const share = track.present[high] ? time - low : 0;
  const between = (values) => values[low] + share * (values[high] - values[low]);
  return { x: between(track.x), y: between(track.y), heading: between(track.heading), speed: between(track.speed) };
}

/** The camera [x, y] at a step: the mean of the ego's way two seconds before and after, up to the contact. */
function cameraAt(replay, time) {
  const ego = replay.tracks.find((track) => track.role === "ego");
  const middle = Math.min(time, replay.contact);
  const reach = Math.min(20, middle, Math.max(replay.contact - middle, 0) + 1e-9);
  const samples = Array.from({ length: 9 }, (_, k) => poseAt(ego, middle + (reach * (k - 4)) / 4));
  return ["x", "y"].map((axis) => samples.reduce((sum, pose) => sum + pose[axis], 0) / samples.length);
}

/**
 * Draw a replay at a step.
 * view: centre [x, y] m and metres along the canvas's shorter side; shown: set of the roles and layers to draw.
 */
function drawScene(canvas, paths, replay, time, view, shown, palette) {
  const context = canvas.getContext("2d");
  const scale = Math.min(canvas.width, canvas.height) / view.metres;
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = palette.ground;
  context.fillRect(0, 0, canvas.width, canvas.height);
  const [x, y] = view.centre;
  context.setTransform(scale, 0, 0, -scale, canvas.width / 2 - x * scale, canvas.height / 2 + y * scale);
  drawMap(context, paths, palette);
  drawTrails(context, replay, Math.min(time, replay.steps - 1), palette);
  if (shown.has("plans")) drawPlans(context, replay, time, palette);
  drawAgents(context, replay, time, palette);
  drawGhosts(context, replay, time, shown, palette);
  if (shown.has("aims")) drawAims(context, replay, time, palette);
  if (time >= replay.contact && replay.point) drawContact(context, replay, palette);
}

function drawMap(context, paths, palette) {
  context.fillStyle = context.strokeStyle = palette.road;
  context.lineCap = context.lineJoin = "round";
  context.fill(paths.area);
  for (const [width, path] of paths.surface) {
    context.lineWidth = width + VERGE;
    context.stroke(path);
  }
  context.strokeStyle = palette.centreline;
  context.lineWidth = 0.16;
  context.stroke(paths.centrelines);
}

/** The ego stays where it was hit. */
const egoTime = (track, replay, time) => (track.role === "ego" ? Math.min(time, replay.contact) : time);

/** Agents from the lowest layer to the highest. */
function agentsOf(replay) {
  const agents = replay.tracks.filter((track) => LAYERS.includes(track.role));
  return agents.sort((first, second) => LAYERS.indexOf(first.role) - LAYERS.indexOf(second.role));
}

function drawTrails(context, replay, time, palette) {
  context.lineCap = "butt";
  for (const track of agentsOf(replay)) {
    const end = Math.floor(egoTime(track, replay, time));
    const begin = Math.max(0, end - Math.round(TRAIL / replay.dt));
    if (Math.hypot(track.x[end] - track.x[begin], track.y[end] - track.y[begin]) < 0.5) continue;
    context.strokeStyle = colourOf(track, palette);
    for (let k = begin; k < end; k++) {
      if (!track.present[k] || !track.present[k + 1]) continue;
      context.globalAlpha = 0.15 + (0.6 * (k - begin)) / (end - begin);
      context.lineWidth = LAYERS.indexOf(track.role) >= 4 ? 0.5 : 0.3;
      context.beginPath();
      context.moveTo(track.x[k], track.y[k]);
      context.lineTo(track.x[k + 1], track.y[k + 1]);
      context.stroke();
    }
  }
  context.globalAlpha = 1;
}

const colourOf = (track, palette) => palette[COLOUR_OF[track.role] ?? track.role];

function drawAgents(context, replay, time, palette) {
  for (const track of agentsOf(replay)) {
    const moment = egoTime(track, replay, time);
    if (!track.present[Math.floor(moment)]) continue;
    const pose = poseAt(track, moment);
    if (track.role === "pedestrian") drawDisc(context, pose, 0.45, colourOf(track, palette));
    else if (track.role === "cyclist") drawCyclist(context, pose, track, palette);
    else
      drawVehicle(
        context,
        pose,
        track,
        colourOf(track, palette),
        track === replay.tracks[replay.partner] && palette.ink,
      );
  }
}

/** Run `draw` in the frame of a pose, in units of half the length and half the width. */
function inFrame(context, pose, { length, width }, draw) {
  context.save();
  context.translate(pose.x, pose.y);
  context.rotate(pose.heading);
  const path = (outline) => {
    const shape = new Path2D();
    trace(
      shape,
      outline.map(([x, y]) => [(x * length) / 2, (y * width) / 2]),
      true,
    );
    return shape;
  };
  draw(path);
  context.restore();
}

/** A car; edge: a colour that sets it off, or false. */
function drawVehicle(context, pose, size, colour, edge = false) {
  inFrame(context, pose, size, (path) => {
    context.fillStyle = colour;
    context.strokeStyle = edge || "rgba(0, 0, 0, 0.45)";
    context.lineWidth = edge ? 0.35 : 0.12;
    context.fill(path(BODY));
    context.stroke(path(BODY));
    context.fillStyle = "rgba(0, 0, 0, 0.45)";
    context.fill(path(WINDSCREEN));
  });
}

function drawCyclist(context, pose, size, palette) {
  drawVehicle(
    context,
    pose,
    { length: Math.max(size.length, 1.7), width: Math.max(size.width, 0.5) },
    palette.vulnerable,
  );
  drawDisc(context, pose, 0.45, palette.vulnerable);
}

function drawDisc(context, { x, y }, radius, colour) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = colour;
  context.fill();
}

/** Outlines of those who were not there: other drivers in the ego's place, the recorded ego. */
function drawGhosts(context, replay, time, shown, palette) {
  for (const track of replay.tracks) {
    if (!GHOSTS.includes(track.role) || !shown.has(track.role) || !track.present[Math.floor(time)]) continue;
    inFrame(context, poseAt(track, time), track, (path) => {
      context.strokeStyle = colourOf(track, palette);
      context.lineWidth = 0.28;
      context.setLineDash(track.role === "recorded" ? [0.3, 0.5] : [1.1, 0.5]);
      context.stroke(path(BODY));
      context.stroke(path(WINDSCREEN));
    });
  }
}

/** A ring between the two that touch, from the moment of the contact on. */
function drawContact(context, replay, palette) {
  const [x, y] = replay.point;
  for (const [colour, width] of [
    [palette.panel, 0.5],
    [palette.contact, 0.28],
  ]) {
    context.beginPath();
    context.arc(x, y, 2.4, 0, 2 * Math.PI);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke();
  }
  drawDisc(context, { x, y }, 0.4, palette.contact);
}
