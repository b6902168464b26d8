// The history of a planner: rates of its versions, and scenes over versions.

const COLUMNS = { preventable: "Preventable failures, %", hit: "Hit, %", progress: "Progress, m" };
const TEXTS = { ego: "Planner", date: "Written", code: "Code" };
const SIZE = { height: 204, left: 38, top: 8, bottom: 170 };
const WIDEST = 640;
const FOLDED = "never"; // the group of scenes that opens on request

class History {
  constructor(data) {
    this.data = data;
    const titles = data.traffics.map(({ title }, index) => [index, title]);
    const traffic = choice("Traffic", titles, (index) => this.show(data.traffics[index]));
    traffic.hidden = titles.length < 2;
    document.getElementById("scope").append(traffic);
    document.getElementById("notes").textContent = data.notes.join(" ");
    const legend = Object.entries(data.kinds).map(([letter, text]) => [letter, letter, text]);
    document.getElementById("legend").append(
      ...[...legend, ["absent", "–", "not driven to an end"]].map(([name, letter, text]) =>
        element("li", {}, element("span", { class: name }, letter), ` ${text}`),
      ),
    );
    onPaletteChange(() => {});
    this.show(data.traffics[0]);
  }

  show(traffic) {
    document.getElementById("lines").replaceChildren(...traffic.lines.map((text) => element("li", {}, text)));
    document.getElementById("chart").replaceChildren(...chart(this.data.versions, traffic));
    document.getElementById("versions").replaceChildren(...this.versionRows(traffic));
    document.getElementById("scenes").replaceChildren(...this.sceneRows(traffic));
    const { clear } = traffic;
    const text = `${clear} ${clear === 1 ? "scene" : "scenes"} without any contact in any version.`;
    document.getElementById("clear").textContent = text;
  }

  versionRows({ rates }) {
    const names = Object.keys(COLUMNS).filter((name) => rates.some((rate) => rate[name].n));
    const { versions } = this.data;
    const texts = Object.keys(TEXTS).filter((name) => versions.some((version) => version[name]));
    const heads = ["", "Version", ...names.map((name) => COLUMNS[name]), ...texts.map((name) => TEXTS[name])];
    const rows = versions.map((version, k) => {
      const { name, page } = version;
      const title = page ? element("a", { href: page }, name) : name;
      const cells = [title, ...names.map((column) => rates[k][column].text), ...texts.map((text) => version[text])];
      const number = element("th", { scope: "row" }, String(k + 1));
      return element("tr", {}, number, ...cells.map((cell) => element("td", {}, cell)));
    });
    const head = element("tr", {}, ...heads.map((text) => element("th", { scope: "col" }, text)));
    return [element("thead", {}, head), element("tbody", {}, ...rows)];
  }

  sceneRows(traffic) {
    const heads = this.data.versions.map(({ name }) => element("th", { scope: "col" }, element("span", {}, name)));
    const head = element("tr", {}, element("th", { scope: "col" }, "Scene"), ...heads);
    const span = heads.length + 1;
    const bodies = traffic.groups.flatMap(({ title, change, rows }) => {
      const body = element("tbody", {}, ...rows.map(([scene, cells]) => this.sceneRow(scene, cells, traffic)));
      const text = `${title}: ${rows.length} ${rows.length === 1 ? "scene" : "scenes"}`;
      const heading = element("th", { colspan: span, scope: "rowgroup" }, text);
      if (change === FOLDED) {
        const button = element("button", { type: "button", "aria-expanded": "false" }, "show");
        button.addEventListener("click", () => {
          body.hidden = !body.hidden;
          button.setAttribute("aria-expanded", String(!body.hidden));
          button.textContent = body.hidden ? "show" : "hide";
        });
        body.hidden = true;
        heading.append(" ", button);
      }
      return [element("tbody", { class: "group" }, element("tr", {}, heading)), body];
    });
    return [element("thead", {}, head), ...bodies];
  }

  sceneRow(scene, cells, { prefixes }) {
    const { versions, kinds } = this.data;
    const marks = cells.map((cell, k) => {
      if (!cell) return element("span", { class: "absent", title: `${versions[k].name}: not driven to an end` }, "–");
      const [kind, count, of, key] = cell;
      const text = of > 1 && kind !== "·" ? kind + count : kind;
      const title = `${versions[k].name}: ${kinds[kind]}${of > 1 ? ` in ${count} of ${of} rollouts` : ""}`;
      const { page } = versions[k];
      if (!page || key === null) return element("span", { class: kind, title }, text);
      const href = `${page}#failure=${encodeURIComponent(prefixes[k] + key)}`;
      return element("a", { class: kind, title, href }, text);
    });
    const name = element("th", { scope: "row" }, scene);
    return element("tr", {}, name, ...marks.map((mark) => element("td", {}, mark)));
  }
}

/** The rate of preventable failures with its intervals over versions: a caption and a plot. */
function chart(versions, { rates, unit }) {
  const { height, left, top, bottom } = SIZE;
  const width = Math.min(WIDEST, document.documentElement.clientWidth - 50);
  const right = width - 10;
  const known = rates.map(({ preventable }, k) => ({ k, ...preventable })).filter(({ n }) => n);
  const highest = Math.max(0.1, ...known.map(({ mean, high }) => high ?? mean));
  const x = linear(-0.5, versions.length - 0.5, left, right);
  const y = linear(0, highest, bottom, top);
  const intervals = known.some(({ low }) => low !== null) ? ", with 95% intervals" : "";
  const title = `Preventable failures, % of ${unit}${intervals}`;
  const node = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": title });
  for (const value of ticks(0, 100 * highest, 4)) {
    const at = y(value / 100);
    node.append(svg("line", { class: "grid", x1: left, x2: right, y1: at, y2: at }));
    node.append(svg("text", { x: left - 5, y: at + 4, "text-anchor": "end" }, String(value)));
  }
  const short = versions.every(({ name }) => 8 * name.length * versions.length < right - left);
  versions.forEach(({ name }, k) => {
    const text = short ? name : String(k + 1);
    node.append(svg("text", { x: x(k), y: bottom + 18, "text-anchor": "middle" }, text));
  });
  const points = known.map(({ k, mean }) => `${x(k)},${y(mean)}`).join(" ");
  node.append(svg("polyline", { class: "rate", points }));
  for (const { k, mean, low, high } of known) {
    if (low !== null) node.append(svg("line", { class: "rate", x1: x(k), x2: x(k), y1: y(low), y2: y(high) }));
    node.append(svg("circle", { cx: x(k), cy: y(mean), r: 4 }));
  }
  return [element("p", { class: "facts" }, title), node];
}

const planner = new History(JSON.parse(document.getElementById("report").textContent));
