// The tables of the run as they stand in tables.md, and what the metrics mean.

function showTables(container, tables) {
  container.replaceChildren(
    ...tables.map((table, index) => {
      const body = element(
        "div",
        { class: "scroll", tabindex: 0, role: "region", "aria-label": tableTitle(table) },
        markTable(table),
      );
      const details = element(
        "details",
        {},
        element("summary", {}, tableTitle(table)),
        body,
        element("p", { class: "caption" }, table.caption),
      );
      details.open = index === 0;
      return details;
    }),
  );
}

/** The section's title, or the first words of the caption: up to a colon, or two sentences. */
const tableTitle = ({ title, caption }) => title || caption.match(/^[^:.]*(\. [^.[;:]*)?/)[0].trim();

function markTable({ head, rows, links }) {
  const columns = head.map((text) => element("th", { scope: "col" }, text));
  const mark = (text, href) => element("td", {}, href ? element("a", { href }, text) : text);
  const body = rows.map(([name, ...cells], row) =>
    element("tr", {}, element("th", { scope: "row" }, name), ...cells.map((text, k) => mark(text, links?.[row]?.[k]))),
  );
  return element("table", {}, element("thead", {}, element("tr", {}, ...columns)), element("tbody", {}, ...body));
}

function showAbout(list, about) {
  list.replaceChildren(
    ...Object.entries(about).flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, text)]),
  );
}
