// Plans of the ego and of its adversaries, and whom these aim at, on the canvas of a scene.

/** The number of the plan that is driven at a step. */
const planAt = (plans, time) => Math.min(Math.floor(time / plans.every), plans.count - 1);

/** The rest of the plans of the ego and of the adversaries, until the contact: a dot every half second. */
function drawPlans(context, { plans, tracks, contact }, time, palette) {
  if (!plans || time >= contact) return;
  const number = planAt(plans, time);
  for (const { track: index, paths } of plans.agents) {
    const track = tracks[index];
    if (!track.present[Math.floor(time)]) continue;
    const { x, y } = poseAt(track, time);
    const ahead = paths[number].filter((_, k) => number * plans.every + (k + 1) * plans.spacing > time);
    context.strokeStyle = colourOf(track, palette);
    context.lineWidth = 0.18;
    context.setLineDash([0.6, 0.5]);
    context.beginPath();
    trace(context, [[x, y], ...ahead]);
    context.stroke();
    context.setLineDash([]);
    for (const [px, py] of ahead) drawDisc(context, { x: px, y: py }, 0.22, colourOf(track, palette));
  }
}

/** Arrows from adversaries to whom they aim at, and their letters. */
function drawAims(context, { plans, tracks, contact }, time, palette) {
  if (!plans) return;
  const number = planAt(plans, Math.min(time, contact));
  for (const { track: index, targets, letter } of plans.agents) {
    if (!letter || !tracks[index].present[Math.floor(time)]) continue;
    const from = poseAt(tracks[index], time);
    drawLetter(context, from, letter, palette);
    if (targets[number] >= 0 && time < contact)
      drawArrow(context, from, poseAt(tracks[targets[number]], time), palette.contact);
  }
}

function drawLetter(context, { x, y }, letter, palette) {
  context.save();
  context.translate(x, y);
  context.scale(1, -1);
  context.font = "bold 2.2px system-ui, sans-serif";
  context.textAlign = "center";
  context.lineWidth = 0.5;
  context.strokeStyle = palette.panel;
  context.fillStyle = palette.ink;
  context.strokeText(letter, 2.4, -1.6);
  context.fillText(letter, 2.4, -1.6);
  context.restore();
}

/** An arrow between two poses, without the boxes themselves. */
function drawArrow(context, from, to, colour) {
  const length = Math.hypot(to.x - from.x, to.y - from.y);
  if (length < 7) return;
  context.save();
  context.translate(from.x, from.y);
  context.rotate(Math.atan2(to.y - from.y, to.x - from.x));
  context.strokeStyle = context.fillStyle = colour;
  context.globalAlpha = 0.7;
  context.lineWidth = 0.2;
  context.beginPath();
  trace(context, [
    [2.6, 0],
    [length - 3.4, 0],
  ]);
  context.stroke();
  context.beginPath();
  trace(
    context,
    [
      [length - 2.6, 0],
      [length - 4, 0.7],
      [length - 4, -0.7],
    ],
    true,
  );
  context.fill();
  context.restore();
}
