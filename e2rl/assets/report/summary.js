// The page in one screen, for who knows no word of its field: one number, three collisions, what was driven.

const CASES = 3;
const FROM = {
  ahead: "a vehicle ahead",
  "from behind": "a vehicle behind it",
  oncoming: "an oncoming vehicle",
}; // where the other vehicle came from; else from the words themselves
const DID = {
  stands: "stood",
  "keeps speed": "kept its speed",
  brakes: "braked",
  accelerates: "sped up",
  "turns left": "turned left",
  "turns right": "turned right",
  "veers left": "swerved to the left",
  "veers right": "swerved to the right",
};
const BROKE = {
  "rear-end": "ran into it from behind",
  light: "ran a red light",
  "wrong way": "drove on the wrong side",
  "right of way": "had to give way",
  entry: "came into its path too close",
}; // the rule that the other vehicle broke

/** The summary of a group of failures by mode, as `show` has them, and how far a run is that goes on. */
function showSummary({ plain, ego }, modes, store, progress) {
  const node = (id) => document.getElementById(id);
  node("plain-link").hidden = !plain;
  if (!plain) return [];
  node("plain-ego").textContent = ego;
  node("plain-number").textContent = plain.number;
  node("plain-meaning").textContent = plain.meaning;
  node("plain-interval").textContent = [progress?.text, plain.interval].filter(Boolean).join(" ");
  node("plain-driven").replaceChildren(
    ...Object.entries(plain.driven).flatMap(([term, text]) => [element("dt", {}, term), element("dd", {}, text)]),
  );
  const size = { "aria-hidden": "true", width: 600, height: 300 };
  const cases = casesOf(modes).map((failure) => ({ failure, picture: element("canvas", size) }));
  node("plain-cases").replaceChildren(
    ...cases.map(({ failure, picture }) => {
      const text = element("span", {}, whatHappened(failure), " ", element("strong", {}, whetherAvoided(failure)));
      return element("li", {}, element("a", { href: `#failure=${failure.key}` }, picture, text));
    }),
  );
  for (const each of cases)
    store.replay(each.failure.replay).then((found) => drawTypical(each.picture, (each.found = found)));
  node("plain-typical").hidden = !cases.length;
  return cases;
}

/** The typical failures of the first modes, those first that a careful driver avoids; of a few modes, several. */
function casesOf(modes) {
  const shown = modes.map(({ failures }) => failures.filter(({ replay }) => replay !== null));
  const avoided = (failure) => failure.preventable === 1;
  const typical = shown.map((failures) => failures.find(avoided) ?? typicalOf(failures)).filter(Boolean);
  const all = new Set([...typical, ...shown.flat()]);
  return [...all].sort((first, second) => avoided(second) - avoided(first)).slice(0, CASES);
}

/** A sentence about a failure. */
function whatHappened(failure) {
  const { approach, ego_manoeuvre: ego, partner_manoeuvre: partner, contact_type: type, relvel, duty } = failure;
  const from = FROM[approach] ?? `a vehicle ${approach.replace("cut-in", "cutting in")}`;
  const rule = BROKE[duty] ? `, which ${BROKE[duty]},` : "";
  const closing = relvel === null ? "" : `, with ${Math.round(3.6 * relvel)} km/h between them`;
  const contact = `they collided at the car’s ${type}${closing}`;
  return `The car ${DID[ego] ?? ego}; ${from}${rule} ${DID[partner] ?? partner}, and ${contact}.`;
}

function whetherAvoided({ preventable, at_fault: fault }) {
  if (preventable === null) return "Whether a careful driver would have avoided it is not known.";
  const text = preventable ? "A careful driver would have avoided it." : "A careful driver would have been hit, too.";
  return fault === 1 ? `${text} The car was at fault.` : text;
}
