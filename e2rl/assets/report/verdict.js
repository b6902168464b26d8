// What is known of a failure, in words.

function showVerdict(list, failure, replay) {
  const speed = (value) => `${fixed(value)} m/s`;
  const facts = {
    Verdict: verdictOf(failure),
    "Duty broken": failure.duty && (failure.duty === "none" ? "none" : `${failure.duty}, by the partner`),
    Approach: failure.approach,
    Ego: `${failure.ego_manoeuvre}, ${speed(failure.ego_speed)} 0.1 s before the contact`,
    Partner: `${failure.partner_manoeuvre}, ${speed(failure.partner_speed)} then; ${roleOf(failure)}, agent ${failure.partner}`,
    Contact: `${failure.contact_type} of the ego after ${fixed(failure.contact_time)} s, closing at ${speed(failure.relvel)}`,
    "Competent driver": replay && driverText(failure, replay),
    Evasion: evasionText(failure),
    "Causal chain": replay?.plans && chainText(replay),
  };
  const known = Object.entries(facts).filter(([, text]) => text);
  list.replaceChildren(...known.flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, text)]));
}

/** Whether the failure counts, and why. */
function verdictOf({ counted, at_fault, preventable }) {
  if (counted === null) return "unknown";
  const reasons = [at_fault === 1 && "ego's fault", preventable === 1 && "preventable"].filter(Boolean);
  return counted ? `counts: ${reasons.join(", ")}` : "does not count";
}

const roleOf = (failure) => (failure.cfr_adv === 1 ? "adversary" : "other traffic");

function driverText({ preventable }, replay) {
  if (preventable === null) return null;
  if (preventable === 0) return "has the collision, or another one";
  const driver = replay.tracks.find((track) => track.role === "driver");
  if (!driver) return "prevents it";
  const least = Math.min(...driver.gap);
  return `prevents it, at least ${fixed(least)} m from the partner`;
}

function evasionText({ avoidable, avoidable_1s, evasion_accel }) {
  if (avoidable === null) return null;
  if (!avoidable) return "the search found none";
  const late = avoidable_1s
    ? "; also one that begins 1 s before the contact"
    : "; none that begins 1 s before the contact";
  return `the search found one with at most ${fixed(evasion_accel)} m/s²${late}`;
}

/** Such as "B → A → ego": whom each adversary aimed at in the last plan before the contact that had an aim. */
function chainText({ plans, contact, tracks }) {
  const adversaries = plans.agents.filter(({ letter }) => letter);
  for (let number = planAt(plans, contact - 1); number >= 0; number--) {
    const aimOf = new Map(adversaries.map(({ track, targets }) => [track, targets[number]]));
    const acting = adversaries.filter(({ track }) => aimOf.get(track) >= 0);
    if (!acting.length) continue;
    const nameOf = (track) => adversaries.find((agent) => agent.track === track)?.letter ?? tracks[track].role;
    const chainFrom = (track, links = acting.length) =>
      links && aimOf.get(track) >= 0 ? `${nameOf(track)} → ${chainFrom(aimOf.get(track), links - 1)}` : nameOf(track);
    const inner = new Set(acting.map(({ track }) => aimOf.get(track)));
    return acting
      .filter(({ track }) => !inner.has(track))
      .map(({ track }) => chainFrom(track))
      .join("; ");
  }
  return null;
}

/** A field to copy from, with its button. */
function copyField(label, text) {
  const field = element("input", { readonly: "", value: text });
  const button = element("button", { type: "button", "aria-label": `Copy: ${label}` }, "Copy");
  button.addEventListener("click", () => {
    field.select();
    document.execCommand("copy"); // which a page from a file, or without https, may use, too
    button.textContent = "Copied";
  });
  return element("div", {}, element("label", {}, label, field), button);
}

/** A button that saves a file attached to a failure. */
function saveButton({ key }, { name, size, data }) {
  const kind = name.slice(key.length + 1);
  const button = element("button", { type: "button" }, `Download ${kind} (${Math.ceil(size / 1024)} kB)`);
  button.addEventListener("click", async () => {
    const href = URL.createObjectURL(new Blob([await inflate(data)], { type: "application/octet-stream" }));
    element("a", { href, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(href), 60000); // ms; browsers read it after the click
  });
  return element("div", {}, button);
}
