// The failure modes: each with its fraction, how many of it count, and a picture of its typical case at the contact.

const OTHER = 0;

/**
 * Modes of some failures: {mode, name, failures, typical, counted}, those with the most failures that count first, then
 * the small groups if any of theirs counts. A mode whose failures nobody holds against the ego says little about it.
 */
function groupByMode(failures, names) {
  const modes = [...groupBy(failures, ({ mode }) => mode)].map(([mode, ours]) => ({
    mode,
    name: modeName(mode, names),
    failures: ours,
    typical: typicalOf(ours),
    counted: ours.filter(({ counted }) => counted !== 0).length, // with an unknown verdict, too
  }));
  return modes.sort(
    (first, second) =>
      !first.counted - !second.counted ||
      (first.mode === OTHER) - (second.mode === OTHER) ||
      second.counted - first.counted ||
      second.failures.length - first.failures.length,
  );
}

const modeName = (mode, names) => (mode === OTHER ? "other: small groups" : names[mode]);

/** The typical failure among them, else the first with a replay. */
const typicalOf = (failures) =>
  failures.find((failure) => failure.typical && failure.replay !== null) ??
  failures.find((failure) => failure.replay !== null) ??
  failures[0];

/** The list of modes; `choose` is called with a mode. */
function showModes(container, modes, total, store, choose) {
  const first = modes.findIndex(({ counted }) => !counted);
  container.replaceChildren(
    ...modes.flatMap((mode, index) => {
      const picture = (mode.picture = element("canvas", { "aria-hidden": "true", width: 240, height: 160 }));
      const button = element(
        "button",
        { type: "button", class: "mode", "aria-pressed": "false" },
        picture,
        modeText(mode, total),
      );
      button.addEventListener("click", () => choose(mode));
      if (mode.typical.replay !== null)
        store.replay(mode.typical.replay).then((found) => drawTypical(picture, (mode.found = found)));
      const apart = index === first ? [element("li", { class: "apart" }, "None of these counts")] : [];
      return [...apart, element("li", {}, button)];
    }),
  );
}

function modeText({ name, failures, counted }, total) {
  const [what, duty] = name.split(": ");
  const bars = [
    element("i", { class: "counts", style: `width: ${(100 * counted) / total}%` }),
    element("i", { style: `width: ${(100 * (failures.length - counted)) / total}%` }),
  ];
  const facts = [`${Math.round(100 * (failures.length / total))}%, ${plural(failures.length, "failure")}`];
  if (failures.some((failure) => failure.counted !== null)) facts.push(counted ? `${counted} count` : "none counts");
  return element(
    "span",
    {},
    element("strong", {}, capital(what)),
    element("small", {}, duty ?? ""),
    element("span", { class: "share", "aria-hidden": "true" }, ...bars),
    element("small", {}, facts.join(" · ")),
  );
}

/** The typical case at its contact. */
function drawTypical(canvas, { replay, paths }) {
  drawScene(canvas, paths, replay, replay.contact, { centre: replay.point, metres: 26 }, new Set(), readPalette());
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);
