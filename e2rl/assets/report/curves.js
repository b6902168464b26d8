// Speeds and gaps of a failure over time, with a cursor at the moment that is shown.

const CURVES = [
  {
    title: "Speed",
    label: "speed [m/s]",
    channel: "speed",
    roles: ["ego", "partner", "driver", "evasion", "recorded"],
  },
  {
    title: "Gap to the partner",
    label: "gap to the partner [m]",
    channel: "gap",
    roles: ["ego", "driver", "evasion", "recorded"],
  },
];
const DASHES = { driver: "6 3", evasion: "6 3", recorded: "2 3" };

/** The plots of a replay; a pointer calls `seek` with a step. Returns a function that moves the cursors to a step. */
function showCurves(container, replay, shown, seek) {
  const plots = CURVES.map((curve) => curvePlot(curve, replay, shown));
  container.replaceChildren(...plots.map((plot) => plot.node));
  plots.forEach((plot) => followPointer(plot, replay, seek));
  return (time) => {
    for (const { cursor, x } of plots) {
      for (const end of ["x1", "x2"]) cursor.setAttribute(end, x(time * replay.dt));
    }
  };
}

/** The tracks of a curve: {role, track}; the partner stands under that name. */
function tracksOf(curve, replay, shown) {
  const named = replay.tracks.map((track, index) => ({
    role: index === replay.partner ? "partner" : track.role,
    track,
  }));
  return named.filter(({ role }) => curve.roles.includes(role) && (!GHOSTS.includes(role) || shown.has(role)));
}

function curvePlot(curve, replay, shown) {
  const lines = tracksOf(curve, replay, shown);
  const end = (replay.steps - 1) * replay.dt;
  const top = Math.max(1, ...lines.flatMap(({ track }) => Array.from(track[curve.channel])));
  const plot = axes({
    width: 420,
    height: 170,
    title: curve.title,
    x: { range: [0, end], label: "time [s]" },
    y: { range: [0, Math.min(top, 60)], label: curve.label },
  });
  const contact = plot.x(replay.contact * replay.dt);
  const mark = { class: "contact", x1: contact, x2: contact, y1: plot.frame.top, y2: plot.frame.bottom };
  if (replay.point) plot.node.append(svg("line", mark));
  plot.node.append(...lines.map((line) => curveLine(line, curve.channel, plot, replay)));
  plot.cursor = svg("line", { class: "cursor", y1: plot.frame.top, y2: plot.frame.bottom });
  plot.node.append(plot.cursor);
  return plot;
}

/** One line; the ego's ends with the contact. */
function curveLine({ role, track }, channel, plot, replay) {
  const last = role === "ego" ? replay.contact : replay.steps - 1;
  const points = [];
  for (let k = 0; k <= last; k++) {
    if (track.present[k]) points.push(`${plot.x(k * replay.dt)},${plot.y(Math.min(track[channel][k], 60))}`);
  }
  const colour = role === "partner" ? (COLOUR_OF[track.role] ?? track.role) : role;
  return svg("polyline", {
    points: points.join(" "),
    fill: "none",
    "stroke-width": 2,
    "stroke-dasharray": DASHES[role] ?? "none",
    style: `stroke: var(--${colour})`,
  });
}

function followPointer({ node, frame }, replay, seek) {
  const move = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const box = node.getBoundingClientRect();
    const pixel = ((event.clientX - box.left) / box.width) * node.viewBox.baseVal.width;
    seek(linear(frame.left, frame.right, 0, replay.steps - 1)(pixel));
  };
  node.addEventListener("pointerdown", move);
  node.addEventListener("pointermove", move);
}
