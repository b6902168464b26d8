// The tables of the run as they stand in tables.md, which sort by a click on a head, and what the metrics mean.

const MANY_ROWS = 10; // of a table from which on its rows can be filtered

function showTables(container, tables) {
  container.replaceChildren(
    ...tables.map((table, index) => {
      const details = element(
        "details",
        {},
        element("summary", {}, tableTitle(table)),
        ...sortedTable(table, tableTitle(table)),
        element("p", { class: "caption" }, table.caption),
      );
      details.open = index === 0;
      return details;
    }),
  );
}

/** The section's title, or the first words of the caption: up to a colon, or two sentences. */
const tableTitle = ({ title, caption }) => title || caption.match(/^[^:.]*(\. [^.[;:]*)?/)[0].trim();

/**
 * A box with a table that a click on a head sorts: upwards, downwards, as it was; with fields that filter its rows,
 * where they are many. names: what its cells may begin with, to choose from.
 */
function sortedTable({ head, rows, links, names = [] }, title) {
  const mark = (text, href) => element("td", {}, href ? element("a", { href }, text) : element("span", {}, text));
  const lines = rows.map(([name, ...cells], row) =>
    element("tr", {}, element("th", { scope: "row" }, name), ...cells.map((text, k) => mark(text, links?.[row]?.[k]))),
  );
  const body = element("tbody");
  const wanted = { text: "", name: "", column: 0, sign: 0 };
  const show = ({ text, name, column, sign } = wanted) => {
    const kept = [...rows.keys()].filter(
      (row) =>
        rows[row].some((cell) => cell.toLowerCase().includes(text)) &&
        rows[row].some((cell) => cell.startsWith(name)),
    );
    if (sign) kept.sort((first, second) => compareCells(rows[first][column], rows[second][column], sign));
    body.replaceChildren(...kept.map((row) => lines[row]));
    heads.forEach((node, index) => node.setAttribute("aria-sort", sortWord(index === column ? sign : 0)));
  };
  const heads = head.map((text, column) =>
    sortHead(text, () => {
      const sign = wanted.column === column && wanted.sign ? (wanted.sign > 0 ? -1 : 0) : 1;
      show(Object.assign(wanted, { column, sign }));
    }),
  );
  const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads)), body);
  const box = element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": title }, table);
  show();
  if (rows.length < MANY_ROWS) return [box];
  const field = element("input", { type: "search", size: 12 });
  const want = (wish) => show(Object.assign(wanted, wish));
  field.addEventListener("input", () => want({ text: field.value.toLowerCase() }));
  const chosen = [["", "all"], ...names.map((name) => [name, name])];
  const outcomes = names.length ? [choice("Outcome", chosen, (name) => want({ name }))] : [];
  // no form: return in its only field would send it, and load the page again
  const label = element("label", {}, "Rows with", field);
  const filters = element("div", { class: "filters", role: "search" }, ...outcomes, label);
  return [filters, box];
}

/** The order of two cells: by their first number, where both begin with one, else as text; unknown ones are last. */
function compareCells(first, second, sign) {
  const [one, other] = [first, second].map((text) => Number.parseFloat(text.replace("−", "-").replaceAll(",", "")));
  const [none, noOther] = [first, second].map((text) => ["", "–"].includes(text));
  if (none || noOther) return none - noOther;
  if (one - other) return sign * (one - other);
  return sign * first.localeCompare(second, undefined, { numeric: true });
}

function showAbout(list, about) {
  list.replaceChildren(
    ...Object.entries(about).flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, text)]),
  );
}
