// Two egos side by side: the failures that are new, gone or moved, and both replays with one clock.

const SIDES = ["first", "second"];
const VIEW = ["name", "scene", "clock", "badge", "scale", "curves", "verdict"]; // of each side

/** A player whose clock moves two replays, each with a canvas and a camera of its own. */
class Duo extends Player {
  constructor(store, step, views) {
    super(store, step);
    Object.assign(this, { views, sides: [] });
    for (const { scene } of views) new ResizeObserver(() => this.resize(scene)).observe(scene);
  }

  async show(pair) {
    this.pair = pair;
    this.pause();
    const found = await Promise.all(pair.replays.map((index) => this.store.replay(index)));
    if (this.pair !== pair) return; // another one was chosen meanwhile
    const replays = found.map(({ replay }) => replay);
    this.sides = found.map((each, k) => ({ ...each, ...this.views[k] }));
    this.failure = failed(pair);
    this.replay = replays.length ? joined(replays) : null;
    this.buildLayers();
    this.buildCurves();
    this.prepareScrubber();
    this.views.forEach(({ scene, badge, verdict }, k) => {
      const { contact, error, contact_type: type, contact_time: seconds, min_dtc: nearest, progress } = pair[SIDES[k]];
      badge.textContent = contact ? `${type} contact at ${fixed(seconds)} s` : "no contact";
      scene.hidden = badge.hidden = !this.replay;
      showVerdict(verdict, pair[SIDES[k]], replays[k]);
      if (!contact) verdict.textContent = `No contact. Nearest ${fixed(nearest)} m, driven ${fixed(progress)} m.`;
      if (error) verdict.textContent = `The planner raised: ${error}`;
    });
    this.seek(0);
  }

  buildCurves() {
    const seek = (time) => this.pauseAt(time);
    const moves = this.sides.map(({ curves, replay }) => showCurves(curves, replay, this.shown, seek));
    this.moveCursors = (time) => moves.forEach((move) => move(time));
  }

  draw() {
    if (!this.replay) return;
    for (const side of this.sides) {
      const time = Math.min(this.time, side.replay.steps - 1);
      const view = { centre: cameraAt(side.replay, time), metres: this.metres };
      drawScene(side.scene, side.paths, side.replay, time, view, this.shown, this.palette);
      this.describe(side, side.replay, time);
    }
    this.moveCursors(this.time);
  }
}

/** What clock and legend need of two replays: the longer one's steps, the first contact, all tracks. */
function joined(replays) {
  const longer = replays.reduce((first, second) => (second.steps > first.steps ? second : first));
  const contact = Math.min(...replays.map((replay) => replay.contact));
  return { ...longer, contact, tracks: replays.flatMap(({ tracks }) => tracks) };
}

/** The nodes of one side; those of the first have the ids of the player's. */
const viewOf = (suffix) =>
  Object.fromEntries(VIEW.map((id) => [id, document.getElementById(`${id}${suffix}`)]));

/** The later one's failure, where it has one. */
const failed = ({ change, first, second }) => (change === "gone" ? first : second);
const titleOf = (pair) => `${capital([pair.change, ...pair.what].join(" "))}: ${failed(pair).named}`;
const placeOf = ({ scene_id: scene, seed, method, eta }) => `${scene}, seed ${seed}, ${method} η=${eta}`;

class Comparison {
  constructor(data) {
    const driven = data.pairs.filter((pair) => SIDES.every((side) => !pair[side].error)); // others have no file
    for (const pair of data.pairs) pair.replays = [];
    driven.forEach((pair, number) => {
      pair.replays = [2 * number, 2 * number + 1].filter((index) => index < data.replays.length);
    });
    document.getElementById("told").append(...data.told.map((text) => element("li", {}, text)));
    document.getElementById("origin").textContent = data.names.map((name, k) => `${name}: ${data.runs[k]}`).join("; ");
    document.getElementById("player").hidden = !data.pairs.length;
    this.player = new Duo(new Store(data), (direction) => this.step(direction), ["", "-second"].map(viewOf));
    this.player.views.forEach(({ name }, k) => (name.textContent = data.names[k]));
    onPaletteChange(() => this.player.repaint());
    const kinds = ["new", "gone", "moved"].map((change) => [change, change]);
    const show = (change) => this.show(data.pairs.filter((pair) => [pair.change, "", String(pair.preventable)].includes(change)));
    document.getElementById("filters").append(choice("Show", [["", "all"], ["true", "preventable"], ...kinds], show));
    show("");
  }

  show(pairs) {
    this.pairs = pairs;
    this.buttons = pairs.map((pair) => {
      const verdict = failed(pair).error ? "a failure of the planner" : verdictOf(failed(pair));
      const text = `${placeOf(pair)}; ${verdict}`;
      const lines = [element("strong", {}, titleOf(pair)), element("small", {}, text)];
      const button = element("button", { type: "button", class: "pair" }, ...lines);
      button.addEventListener("click", () => {
        this.open(pair);
        if (matchMedia("(max-width: 900px)").matches) document.getElementById("player").scrollIntoView();
      });
      return button;
    });
    document.getElementById("list-title").textContent = `${pairs.length} failures: new, gone or moved`;
    document.getElementById("pairs").replaceChildren(...this.buttons.map((button) => element("li", {}, button)));
    if (pairs.length) this.open(pairs[0]);
  }

  open(pair) {
    const at = this.pairs.indexOf(pair);
    this.buttons.forEach((button, index) => button.setAttribute("aria-pressed", String(index === at)));
    scrollInto(document.getElementById("pairs"), this.buttons[at]);
    document.getElementById("failure-title").textContent = titleOf(pair);
    document.getElementById("failure-facts").textContent = `scene ${placeOf(pair)}`;
    this.player.show(pair);
  }

  step(direction) {
    const { length } = this.pairs;
    if (length) this.open(this.pairs[(this.pairs.indexOf(this.player.pair) + direction + length) % length]);
  }
}

const comparison = new Comparison(JSON.parse(document.getElementById("report").textContent));
