// The index of failures: filters, sorting, and a row each.

/** A column of words; kind: classes of its cells. */
const words = (title, value, kind = "") => ({ title, value, text: value, kind });
/** A column of a measured value. */
const measure = (title, name, kind = "") => ({
  title,
  value: (failure) => failure[name],
  text: (failure) => fixed(failure[name]),
  kind: `number ${kind}`,
});

const SCENE = words("Scene", (failure) => failure.scene_id);
const trafficOf = ({ method, eta }) => `${method} η=${eta}`;
const FILTERED = [
  words("Traffic", trafficOf),
  words("Contact", (failure) => failure.contact_type),
  words("Approach", (failure) => failure.approach),
  words("Verdict", verdictOf),
  words("Duty broken", (failure) => failure.duty, "wide"),
  words("Partner", roleOf, "wide"),
]; // columns with a filter each
const COLUMNS = [
  {
    title: "Mode",
    value: (failure) => failure.mode || Infinity,
    text: (failure) => (failure.mode ? String(failure.mode) : "other"),
    kind: "number",
  },
  SCENE,
  words("Seed", (failure) => String(failure.seed), "number wide"),
  ...FILTERED,
  measure("Ego [m/s]", "ego_speed"),
  measure("Partner [m/s]", "partner_speed", "wide"),
  measure("Closing [m/s]", "relvel", "wide"),
  measure("Time [s]", "contact_time"),
];

class Index {
  /** choose: called with the failure that is clicked; names: of the modes. */
  constructor(choose, names) {
    const order = { column: COLUMNS.indexOf(SCENE), sign: 1 };
    Object.assign(this, { choose, names, failures: [], wanted: {}, order, rows: new Map() });
    this.filters = document.getElementById("filters");
    this.table = document.getElementById("index");
    this.title = document.getElementById("index-title");
  }

  /** Take other failures; all filters start anew. */
  load(failures) {
    this.failures = failures;
    this.wanted = {};
    this.buildFilters();
    this.show();
  }

  buildFilters() {
    const modes = [...new Set(this.failures.map(({ mode }) => mode))].sort(
      (first, second) => (first || Infinity) - (second || Infinity),
    );
    const named = modes.map((mode) => [String(mode), `${mode || ""} ${modeName(mode, this.names)}`.trim()]);
    const selects = FILTERED.map(({ title, value }) => {
      const values = [...new Set(this.failures.map(value))].filter(Boolean).sort();
      return this.filter(
        title,
        values.map((text) => [text, text]),
        (failure, text) => value(failure) === text,
      );
    });
    const reset = element("button", { type: "button" }, "Reset");
    reset.addEventListener("click", () => this.load(this.failures));
    this.filters.replaceChildren(
      this.filter("Mode", named, (failure, mode) => String(failure.mode) === mode),
      ...selects,
      this.field("Ego faster than [m/s]", "number", (failure, least) => failure.ego_speed > Number(least)),
      this.field("Scene", "search", (failure, text) => failure.scene_id.includes(text)),
      reset,
    );
  }

  filter(label, options, keeps) {
    return choice(label, [["", "all"], ...options], (value) =>
      this.want(label, value && ((failure) => keeps(failure, value))),
    );
  }

  field(label, type, keeps) {
    const input = element("input", { type, size: 8, min: 0 });
    input.addEventListener("input", () => this.want(label, input.value && ((failure) => keeps(failure, input.value))));
    return element("label", {}, label, input);
  }

  /** Keep only failures for which `keeps` holds; "": no such filter. */
  want(label, keeps) {
    this.wanted[label] = keeps;
    this.show();
  }

  /** Set some filters, {label: value}. */
  filterBy(wanted) {
    for (const label of this.filters.querySelectorAll("label")) {
      const value = wanted[label.firstChild.data];
      if (value === undefined) continue;
      label.lastChild.value = value;
      label.lastChild.dispatchEvent(new Event("change"));
    }
  }

  /** The failures that pass all filters, in order. */
  found() {
    const keeps = Object.values(this.wanted).filter(Boolean);
    const { value } = COLUMNS[this.order.column];
    const compare = (first, second) => (first < second ? -1 : first > second ? 1 : 0);
    const passed = this.failures.filter((failure) => keeps.every((keep) => keep(failure)));
    return passed.sort((first, second) => this.order.sign * compare(value(first), value(second)));
  }

  show() {
    const found = this.found();
    this.title.textContent =
      found.length === this.failures.length
        ? `All failures (${found.length})`
        : `${found.length} of ${this.failures.length} failures`;
    this.rows = new Map(found.map((failure) => [failure, this.row(failure)]));
    this.table.replaceChildren(
      element("thead", {}, element("tr", {}, ...COLUMNS.map((_, column) => this.head(column)))),
      element("tbody", {}, ...(COLUMNS[this.order.column] === SCENE ? this.byScene(found) : this.rows.values())),
    );
    this.mark(this.current);
  }

  /** The rows with a heading for each scene, which says in which traffic it fails. */
  byScene(found) {
    return [...groupBy(found, ({ scene_id: scene }) => scene)].flatMap(([scene, ours]) => {
      const text = `${scene}: ${plural(ours.length, "failure")} in ${[...new Set(ours.map(trafficOf))].join(", ")}`;
      const head = element("th", { colspan: COLUMNS.length, scope: "rowgroup" }, element("span", {}, text));
      return [element("tr", { class: "scene" }, head), ...ours.map((failure) => this.rows.get(failure))];
    });
  }

  head(column) {
    const { title, kind } = COLUMNS[column];
    const { order } = this;
    const sort = () => {
      this.order = { column, sign: order.column === column ? -order.sign : 1 };
      this.show();
      this.table.querySelectorAll("thead button")[column].focus();
    };
    const node = sortHead(title, sort, kind);
    node.setAttribute("aria-sort", sortWord(order.column === column ? order.sign : 0));
    return node;
  }

  row(failure) {
    const cells = COLUMNS.map((column) => {
      const text = column.text(failure);
      const content = column === SCENE ? element("button", { type: "button" }, text) : text; // for the keyboard
      return element("td", { class: column.kind }, content);
    });
    const node = element("tr", {}, ...cells);
    node.addEventListener("click", () => this.choose(failure));
    return node;
  }

  /** Mark the failure that is shown. */
  mark(failure) {
    this.rows.get(this.current)?.removeAttribute("aria-current");
    this.current = failure;
    const row = this.rows.get(failure);
    row?.setAttribute("aria-current", "true");
    if (row) scrollInto(document.getElementById("index-scroll"), row);
  }

  /** The failure `direction` rows from the current one. */
  neighbour(direction) {
    const found = [...this.rows.keys()];
    const at = found.indexOf(this.current);
    return found[(at + direction + found.length) % found.length];
  }
}

/** Scroll a box, and not the page, so that a row of it can be seen. */
function scrollInto(box, row) {
  const head = 30; // px of the heading that stays
  const above = row.offsetTop - head - box.scrollTop;
  const below = row.offsetTop + row.offsetHeight - box.scrollTop - box.clientHeight;
  if (above < 0) box.scrollTop += above;
  else if (below > 0) box.scrollTop += below;
}
