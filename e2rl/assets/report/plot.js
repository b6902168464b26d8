// Elements of HTML and SVG, and the axes of plots. Text of the data goes into text nodes only, never into markup.

function element(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

function svg(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

/** Items by their key, a Map in the order in which keys appear. */
function groupBy(items, keyOf) {
  const groups = new Map(items.map((item) => [keyOf(item), []]));
  for (const item of items) groups.get(keyOf(item)).push(item);
  return groups;
}

/** A number with one decimal, or a dash where it is unknown. */
const fixed = (value) => (value === null ? "–" : value.toFixed(1));

/** A head of a column, whose button sorts by it. */
function sortHead(title, sort, kind = "") {
  const button = element("button", { type: "button" }, title || "name");
  button.addEventListener("click", sort);
  return element("th", { scope: "col", class: kind, "aria-sort": "none" }, button);
}

const sortWord = (sign) => (sign ? (sign > 0 ? "ascending" : "descending") : "none");

/** A labelled select of {value: text}; `change` is called with the value. */
function choice(label, options, change) {
  const select = element("select", {}, ...options.map(([value, text]) => element("option", { value }, text)));
  select.addEventListener("change", () => change(select.value));
  return element("label", {}, label, select);
}

/** A linear scale from values [low, high] to pixels [from, to]. */
const linear = (low, high, from, to) => (value) => from + ((value - low) / (high - low || 1)) * (to - from);

/** Round values between low and high, about `count` of them. */
function ticks(low, high, count) {
  const rough = (high - low) / count || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from(
    { length: Math.floor(high / step + 1e-9) - first + 1 },
    (_, k) => +((first + k) * step).toPrecision(6),
  );
}

/** An empty plot: its node, the scales x and y, and the frame in pixels. */
function axes({ width, height, x, y, title }) {
  const frame = { left: 38, right: width - 10, top: 20, bottom: height - 30 };
  const scaleX = linear(...x.range, frame.left, frame.right);
  const scaleY = linear(...y.range, frame.bottom, frame.top);
  const node = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": title });
  for (const value of ticks(...y.range, 4)) {
    const at = scaleY(value);
    node.append(svg("line", { class: "grid", x1: frame.left, x2: frame.right, y1: at, y2: at }));
    node.append(svg("text", { x: frame.left - 5, y: at + 4, "text-anchor": "end" }, String(value)));
  }
  for (const value of ticks(...x.range, 8)) {
    node.append(svg("text", { x: scaleX(value), y: frame.bottom + 14, "text-anchor": "middle" }, String(value)));
  }
  node.append(svg("text", { x: frame.left - 30, y: 11 }, y.label));
  node.append(svg("text", { x: frame.right, y: height - 3, "text-anchor": "end" }, x.label));
  return { node, x: scaleX, y: scaleY, frame };
}
