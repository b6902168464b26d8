// Collision rates over the realism of the traffic, with intervals; a line joins the intensities of a method.

const RATES = { cfr: "collisions [%]", cfr_counted: "collisions that count [%]" };
const REALISMS = { real: "realism of the traffic", real_adv: "realism of the adversaries" };
const SERIES = ["ego", "adversary", "driver", "vulnerable", "evasion", "traffic"];

/** The plot of an ego's points, and below it what the numbers stand for. */
function showRealism(container, points, rate, realism) {
  const known = points.filter(({ values }) => values[rate] && values[realism]);
  if (!known.length)
    return container.replaceChildren(element("p", { class: "notice" }, "The run does not know these metrics."));
  const methods = [...new Set(known.map(({ method }) => method))];
  const ends = (name, scale) =>
    known.flatMap(({ values }) =>
      ["mean", "low", "high"].map((key) => scale * (values[name][key] ?? values[name].mean)),
    );
  const reach = ends(realism, 1);
  const plot = axes({
    width: 560,
    height: 340,
    title: `${RATES[rate]} over ${REALISMS[realism]}`,
    x: {
      range: [Math.max(0, Math.min(...reach) - 0.03), Math.min(1, Math.max(...reach) + 0.03)],
      label: `${REALISMS[realism]} (1: like the recordings)`,
    },
    y: { range: [0, Math.max(5, ...ends(rate, 100)) * 1.05], label: RATES[rate] },
  });
  for (const method of methods)
    drawMethod(plot, known, method, rate, realism, SERIES[methods.indexOf(method) % SERIES.length]);
  const legend = known.map(({ method, eta, values }) =>
    element(
      "li",
      {},
      `${method} η=${eta}: ${estimate(values[rate], 100, 1)}%, realism ${estimate(values[realism], 1, 3)}`,
    ),
  );
  container.replaceChildren(plot.node, element("ol", {}, ...legend));
}

function drawMethod(plot, known, method, rate, realism, colour) {
  const ours = known.filter((point) => point.method === method).sort((first, second) => first.eta - second.eta);
  const at = ({ values }) => [plot.x(values[realism].mean), plot.y(100 * values[rate].mean)];
  const style = `stroke: var(--${colour})`;
  plot.node.append(svg("polyline", { points: ours.map(at).join(" "), fill: "none", style }));
  for (const point of ours) {
    const [x, y] = at(point);
    const bars = [
      [realism, plot.x, 1, "x"],
      [rate, plot.y, 100, "y"],
    ];
    for (const [name, scale, factor, axis] of bars) {
      const { low, high } = point.values[name];
      if (low === null) continue;
      const ends = {
        x1: x,
        x2: x,
        y1: y,
        y2: y,
        [`${axis}1`]: scale(factor * low),
        [`${axis}2`]: scale(factor * high),
      };
      plot.node.append(svg("line", { ...ends, style, "stroke-opacity": 0.45 }));
    }
    plot.node.append(svg("circle", { cx: x, cy: y, r: 8, style: `fill: var(--panel); ${style}`, "stroke-width": 2 }));
    plot.node.append(svg("text", { x, y: y + 4, "text-anchor": "middle" }, String(known.indexOf(point) + 1)));
  }
}

/** Such as "12.3 [8.1, 16.4]". */
function estimate({ mean, low, high }, factor, decimals) {
  const text = (value) => (factor * value).toFixed(decimals);
  return low === null ? text(mean) : `${text(mean)} [${text(low)}, ${text(high)}]`;
}
