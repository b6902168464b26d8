// The atlas of preventable failures: a grid of approaches and duties, in it a button per cell.

const SHADES = [55, 5]; // % of the accent in a button's colour: fewest nats, most nats

/**
 * Cells of some failures, that of the likeliest failure first: the words of its name, {cell, failures, scenes}. The first
 * of its failures is its likeliest.
 */
function groupByCell(failures, cells) {
  const placed = failures.filter(({ cell }) => cell !== null).sort((first, second) => first.rank - second.rank);
  return [...groupBy(placed, ({ cell }) => cell)].map(([cell, ours]) => ({
    ...cells[cell],
    cell,
    failures: ours,
    scenes: new Set(ours.map(({ scene_id: scene }) => scene)).size,
  }));
}

/** The grid; `choose` is called with the likeliest failure of a cell. */
function showAtlas(container, atlas, choose) {
  document.getElementById("atlas-title").textContent = `Atlas (${plural(atlas.length, "cell")})`;
  if (!atlas.length)
    return container.replaceChildren(element("p", { class: "notice" }, "No failure here is known to be preventable."));
  const wordsOf = (name) => [...new Set(atlas.map((cell) => cell[name]))].sort();
  const duties = wordsOf("duty");
  const shade = shadesOf(atlas);
  const heads = duties.map((duty) => element("th", { scope: "col" }, duty ? `duty: ${duty}` : "duty unknown"));
  const rows = wordsOf("approach").map((approach) => {
    const fields = duties.map((duty) => {
      const ours = atlas.filter((cell) => cell.approach === approach && cell.duty === duty);
      return element("td", {}, ...ours.map((cell) => cellButton(cell, shade(cell), choose)));
    });
    return element("tr", {}, element("th", { scope: "row" }, approach), ...fields);
  });
  const corner = element("th", { scope: "col" }, "approach");
  container.replaceChildren(
    element("table", {}, element("thead", {}, element("tr", {}, corner, ...heads)), element("tbody", {}, ...rows)),
  );
}

/** A button that shows the cell's likeliest failure. */
function cellButton({ cell, failures, scenes, ...words }, shade, choose) {
  const [likeliest] = failures;
  const { partner_manoeuvre: partner, contact_type: contact, speed_band: speed } = words;
  const button = element(
    "button",
    {
      type: "button",
      class: shade === null ? "cell unknown" : "cell",
      "aria-pressed": "false",
      "data-cell": cell,
      title: `Approach ${words.approach}, duty ${words.duty || "unknown"}, in ${plural(scenes, "scene")}`,
      style: `--shade: ${shade ?? 0}%`,
    },
    element("strong", {}, partner || "partner unknown"),
    element("small", {}, [contact, speed].filter(Boolean).join(", ")),
    element("small", {}, `${plural(failures.length, "failure")} · ${natsOf(likeliest)}`),
  );
  button.addEventListener("click", () => choose(likeliest));
  return button;
}

/** A function of cells: the shade [%] of their nats, even in their logarithm as they span decades; null if unknown. */
function shadesOf(atlas) {
  const effort = ({ failures: [{ transport }] }) => Math.log1p(Math.max(0, transport));
  const known = ({ failures: [{ transport }] }) => transport !== null;
  const efforts = atlas.filter(known).map(effort);
  const scale = linear(Math.min(...efforts), Math.max(...efforts), ...SHADES);
  return (cell) => (known(cell) ? scale(effort(cell)) : null);
}

/** Such as "0.4 nats" or "1,234 nats". */
function natsOf({ transport }) {
  if (transport === null) return "nats unknown";
  const digits = { maximumFractionDigits: transport < 10 ? 1 : 0 };
  return `${transport.toLocaleString("en", digits)} nats`;
}

/** Mark the cell of the failure that is shown. */
function markCell(container, failure) {
  for (const button of container.querySelectorAll(".cell"))
    button.setAttribute("aria-pressed", String(Number(button.dataset.cell) === failure.cell));
}

const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
