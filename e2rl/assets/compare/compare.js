// Two runs side by side: a list of the failures that are new, gone or moved, and both replays with one clock.

const SIDES = ["a", "b"];

/** A player whose clock moves two replays; each has a canvas and a camera of its own. */
class Duo extends Player {
  constructor(store, step, views) {
    super(store, step);
    this.views = views;
    this.sides = [];
    for (const { scene } of views) new ResizeObserver(() => this.resize(scene)).observe(scene);
  }

  async show(pair) {
    this.pair = pair;
    this.pause();
    const found = await Promise.all(pair.replays.map((index) => this.store.replay(index)));
    if (this.pair !== pair) return; // another one was chosen meanwhile
    this.sides = found.map((each, k) => ({ ...this.views[k], ...each, facts: pair[SIDES[k]] }));
    this.failure = SIDES.map((side) => pair[side]).find(({ contact }) => contact);
    const replays = found.map(({ replay }) => replay);
    this.replay = replays.length ? joined(replays) : null;
    this.views.forEach(({ verdict }, k) => showFacts(verdict, pair[SIDES[k]], replays[k]));
    this.buildLayers();
    this.buildCurves();
    this.prepareScrubber();
    for (const { badge, facts } of this.sides)
      badge.textContent = facts.contact
        ? `${facts.contact_type} contact at ${fixed(facts.contact_time)} s, ${fixed(facts.relvel)} m/s`
        : "no contact";
    this.seek(0);
  }

  buildCurves() {
    const moves = this.sides.map(({ curves, replay }) =>
      showCurves(curves, replay, this.shown, (time) => this.pauseAt(time)),
    );
    this.moveCursors = (time) => moves.forEach((move) => move(time));
  }

  draw() {
    for (const view of this.views) view.scene.hidden = !this.replay;
    for (const side of this.sides) {
      const time = Math.min(this.time, side.replay.steps - 1);
      const view = { centre: cameraAt(side.replay, time), metres: this.metres };
      drawScene(side.scene, side.paths, side.replay, time, view, this.shown, this.palette);
      this.describe(side, side.replay, time);
    }
    if (this.replay) this.moveCursors(this.time);
  }
}

/** What the clock and the legend need of two replays: the longer one's steps, the first contact, all tracks. */
function joined(replays) {
  const [longer] = [...replays].sort((first, second) => second.steps - first.steps);
  return {
    ...longer,
    contact: Math.min(...replays.map(({ contact }) => contact)),
    tracks: replays.flatMap(({ tracks }) => tracks),
  };
}

function showFacts(list, facts, replay) {
  if (facts.contact) return showVerdict(list, facts, replay);
  const known = { Verdict: "no contact", Nearest: `${fixed(facts.min_dtc)} m`, Driven: `${fixed(facts.progress)} m` };
  list.replaceChildren(...Object.entries(known).flatMap((pair) => ["dt", "dd"].map((tag, k) => element(tag, {}, pair[k]))));
}

/** Canvas with clock, badge and scale, and below it curves and verdict, of one side; the first has the player's ids. */
function buildView(name, index) {
  const view = {
    scene: element("canvas", { tabindex: 0, role: "img" }),
    clock: element("output", { class: "clock" }),
    badge: element("p", { class: "badge" }),
    scale: element("div", { class: "scale" }),
    curves: element("div", { class: "curves" }),
    verdict: element("dl", { class: "verdict" }),
  };
  if (!index) for (const [id, node] of Object.entries(view)) node.id = id;
  const stage = element("div", { class: "stage" }, view.scene, view.clock, view.badge, view.scale);
  document.getElementById("views").append(element("div", {}, element("h3", {}, name), stage));
  document.getElementById("details").append(element("div", {}, view.verdict, view.curves));
  return view;
}

class Comparison {
  constructor(data) {
    this.data = data;
    data.pairs.forEach((pair, number) => {
      pair.traffic = pair.eta ? `${pair.method} η=${pair.eta}` : pair.method;
      pair.replays = [2 * number, 2 * number + 1].filter((index) => index < data.replays.length);
    });
    document.getElementById("told").append(...data.told.map((text) => element("li", {}, text)));
    document.getElementById("origin").textContent = data.names.map((name, k) => `${name}: ${data.runs[k]}`).join("; ");
    showTables(document.getElementById("tables"), data.tables);
    document.getElementById("player").hidden = !data.pairs.length;
    this.player = new Duo(new Store(data), (direction) => this.step(direction), data.names.map(buildView));
    onPaletteChange(() => this.player.repaint());
    this.wanted = {};
    const filters = [
      this.filter("Change", ({ change }) => change),
      this.filter("Traffic", ({ traffic }) => traffic),
      this.filter("Verdict", (pair) => verdictOf(failed(pair))),
    ];
    document.getElementById("filters").append(...filters);
    this.show();
  }

  /** A select of the values that `value` has of the pairs. */
  filter(label, value) {
    const values = [...new Set(this.data.pairs.map(value))];
    return choice(label, [["", "all"], ...values.map((text) => [text, text])], (text) => {
      this.wanted[label] = (pair) => !text || value(pair) === text;
      this.show();
    });
  }

  show() {
    this.pairs = this.data.pairs.filter((pair) => Object.values(this.wanted).every((keeps) => keeps(pair)));
    this.buttons = this.pairs.map((pair) => this.button(pair));
    const count = `${this.pairs.length} failure${this.pairs.length === 1 ? "" : "s"}`;
    document.getElementById("list-title").textContent = `${count} new, gone or moved`;
    document.getElementById("pairs").replaceChildren(...this.buttons.map((button) => element("li", {}, button)));
    if (this.pairs.length) this.open(this.pairs[0]);
  }

  button(pair) {
    const told = `${pair.scene_id}, seed ${pair.seed}, ${pair.traffic}; ${verdictOf(failed(pair))}`;
    const lines = [element("strong", {}, titleOf(pair)), element("small", {}, told)];
    const button = element("button", { type: "button", class: `pair ${pair.change}` }, ...lines);
    button.addEventListener("click", () => {
      this.open(pair);
      if (matchMedia("(max-width: 900px)").matches) document.getElementById("player").scrollIntoView();
    });
    return button;
  }

  open(pair) {
    const at = this.pairs.indexOf(pair);
    this.buttons.forEach((button, index) => button.setAttribute("aria-pressed", String(index === at)));
    const box = document.getElementById("pairs");
    box.scrollTop = this.buttons[at].offsetTop - box.offsetTop - box.clientHeight / 3;
    document.getElementById("failure-title").textContent = titleOf(pair);
    document.getElementById("failure-facts").textContent = `scene ${pair.scene_id}, seed ${pair.seed}, ${pair.traffic}`;
    this.player.show(pair);
  }

  step(direction) {
    const { length } = this.pairs;
    if (length) this.open(this.pairs[(this.pairs.indexOf(this.player.pair) + direction + length) % length]);
  }
}

/** The rollout of a pair that is told: of both failures the later run's. */
const failed = ({ change, a, b }) => (change === "gone" ? a : b);
const titleOf = (pair) =>
  `${capital(pair.change)}${pair.what.length ? ` (${pair.what.join(", ")})` : ""}: ${failed(pair).named}`;

const comparison = new Comparison(JSON.parse(document.getElementById("report").textContent));
