// The replay of one failure: canvas, time, layers, curves and verdict.

const LAYER_NAMES = {
  plans: "plans",
  aims: "whom adversaries aim at",
  driver: "competent driver",
  evasion: "evasion found by search",
  recorded: "ego as recorded",
};
const PLAY_ICON = "M1.5 0v10l8-5z",
  PAUSE_ICON = "M1 0h3v10h-3zM6 0h3v10h-3z";
const NEAREST_VIEW = 15,
  WIDEST_VIEW = 250; // m along the shorter side

class Player {
  /** store: of decoded replays and maps; step(direction): go to another failure. */
  constructor(store, step) {
    this.store = store;
    this.node = Object.fromEntries([...document.querySelectorAll("[id]")].map((node) => [node.id, node]));
    this.shown = new Set(["driver", "plans", "aims"]);
    Object.assign(this, { replay: null, time: 0, playing: false, metres: 60 });
    this.palette = readPalette();
    const on = (id, type, act) => document.getElementById(id).addEventListener(type, act);
    on("play", "click", () => this.toggle());
    on("previous", "click", () => step(-1));
    on("next", "click", () => step(1));
    on("scrubber", "input", () => this.seek(Number(this.node.scrubber.value)));
    on("closer", "click", () => this.zoom(0.8));
    on("farther", "click", () => this.zoom(1.25));
    addEventListener("keydown", (event) => this.onKey(event, step));
    new ResizeObserver(() => this.resize()).observe(this.node.scene);
  }

  repaint() {
    this.palette = readPalette();
    this.draw();
  }

  /** Show a failure, from the time of its start or from `time`. */
  async show(failure, title, time = 0) {
    this.failure = failure;
    this.pause();
    this.node["failure-title"].textContent = title;
    this.node["failure-facts"].textContent =
      `scene ${failure.scene_id}, seed ${failure.seed}, ${failure.method} η=${failure.eta}`;
    const found = failure.replay === null ? null : await this.store.replay(failure.replay);
    if (this.failure !== failure) return; // another one was chosen meanwhile
    this.replay = found && found.replay;
    this.paths = found && found.paths;
    showVerdict(this.node.verdict, failure, this.replay);
    this.buildLayers();
    this.buildCurves();
    this.prepareScrubber();
    this.seek(time);
  }

  prepareScrubber() {
    this.node.absent.hidden = this.replay !== null;
    for (const id of ["play", "scrubber", "rate"]) this.node[id].disabled = !this.replay;
    this.node["contact-mark"].hidden = !this.replay;
    if (!this.replay) return;
    const { steps, contact } = this.replay;
    this.node.scrubber.max = steps - 1;
    this.node["contact-mark"].style.left = `calc(8px + (100% - 16px) * ${contact / (steps - 1)})`;
    const { contact_type: type, contact_time: seconds, relvel } = this.failure;
    this.node.badge.textContent = `contact at ${fixed(seconds)} s: ${type}, ${fixed(relvel)} m/s`;
  }

  /** A legend of the agents that are there, and a box to tick for each layer. */
  buildLayers() {
    const roles = this.replay ? new Set(this.replay.tracks.map((track) => track.role)) : new Set();
    const agents = LAYERS.filter((role) => roles.has(role)).reverse();
    const legend = agents.map((role) => element("span", {}, legendKey(role), role));
    if (this.replay?.plans) roles.add("plans");
    if (this.replay?.plans && roles.has("adversary")) roles.add("aims");
    const boxes = Object.keys(LAYER_NAMES)
      .filter((layer) => roles.has(layer))
      .map((layer) => {
        const box = element("input", { type: "checkbox" });
        box.checked = this.shown.has(layer);
        box.addEventListener("change", () => this.setShown(layer, box.checked));
        return element(
          "label",
          {},
          box,
          " ",
          ...(GHOSTS.includes(layer) ? [legendKey(layer)] : []),
          LAYER_NAMES[layer],
        );
      });
    this.node.layers.replaceChildren(...legend, ...boxes);
  }

  setShown(layer, on) {
    if (on) this.shown.add(layer);
    else this.shown.delete(layer);
    this.buildCurves();
    this.draw();
  }

  buildCurves() {
    if (!this.replay) return this.node.curves.replaceChildren();
    this.moveCursors = showCurves(this.node.curves, this.replay, this.shown, (time) => this.pauseAt(time));
    this.moveCursors(this.time);
  }

  seek(time) {
    const last = this.replay ? this.replay.steps - 1 : 0;
    this.time = Math.max(0, Math.min(time, last));
    this.node.scrubber.value = Math.round(this.time);
    if (this.replay)
      this.node.scrubber.setAttribute("aria-valuetext", `${(this.time * this.replay.dt).toFixed(1)} s`);
    this.draw();
  }

  toggle() {
    if (this.playing) return this.pause();
    if (!this.replay) return;
    if (this.time >= this.replay.steps - 1) this.time = 0;
    this.setPlaying(true);
    let before = performance.now();
    const frame = (now) => {
      if (!this.playing) return;
      this.advance((now - before) / 1000);
      before = now;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  /** Go on by some seconds of wall time; playing stops at the contact and at the end. */
  advance(seconds) {
    const { contact, steps, dt } = this.replay;
    const after = this.time + (Math.max(0, seconds) * Number(this.node.rate.value)) / dt;
    const stop = this.time < contact ? contact : steps - 1;
    if (after >= stop) this.setPlaying(false);
    this.seek(Math.min(after, stop));
  }

  pause() {
    this.setPlaying(false);
  }

  pauseAt(time) {
    this.pause();
    this.seek(time);
  }

  setPlaying(playing) {
    this.playing = playing;
    this.node.play.querySelector("path").setAttribute("d", playing ? PAUSE_ICON : PLAY_ICON);
    this.node.play.setAttribute("aria-label", playing ? "Pause" : "Play");
  }

  zoom(factor) {
    this.metres = Math.max(NEAREST_VIEW, Math.min(WIDEST_VIEW, this.metres * factor));
    this.draw();
  }

  resize(scene = this.node.scene) {
    scene.width = Math.round(scene.clientWidth * devicePixelRatio);
    scene.height = Math.round(scene.clientHeight * devicePixelRatio);
    this.draw();
  }

  draw() {
    const { scene } = this.node;
    if (!this.replay) {
      this.node.badge.hidden = true;
      this.node.clock.textContent = "";
      return scene.getContext("2d").clearRect(0, 0, scene.width, scene.height);
    }
    const view = { centre: cameraAt(this.replay, this.time), metres: this.metres };
    drawScene(scene, this.paths, this.replay, this.time, view, this.shown, this.palette);
    this.moveCursors(this.time);
    this.describe(this.node, this.replay, this.time);
  }

  /** Clock, badge, scale and the canvas's description. */
  describe({ scene, clock, badge, scale }, replay, time) {
    const ego = replay.tracks.find((track) => track.role === "ego");
    const seconds = (time * replay.dt).toFixed(1);
    const speed = poseAt(ego, Math.min(time, replay.contact)).speed.toFixed(1);
    clock.textContent = `${seconds} s\nego ${time > replay.contact ? "hit at " : ""}${speed} m/s`;
    badge.hidden = time < replay.contact;
    scene.setAttribute("aria-label", `Traffic from above at ${seconds} s; the ego drives ${speed} m/s`);
    scale.style.width = `${(10 * Math.min(scene.clientWidth, scene.clientHeight)) / this.metres}px`;
    scale.textContent = "10 m";
  }

  /** Keys that the page itself does not need: a button takes the space bar, fields take all keys. */
  onKey(event, step) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input:not([type=range]), select"))
      return;
    if (event.key === " " && event.target.closest("button, summary")) return;
    const act = {
      " ": () => this.toggle(),
      ArrowLeft: () => this.pauseAt(Math.ceil(this.time) - 1),
      ArrowRight: () => this.pauseAt(Math.floor(this.time) + 1),
      n: () => step(1),
      p: () => step(-1),
      "+": () => this.zoom(0.8),
      "-": () => this.zoom(1.25),
    }[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }
}

/** A box in the colour of a role; dashed for those who were not there. */
function legendKey(role) {
  const colour = `var(--${COLOUR_OF[role] ?? role})`;
  if (GHOSTS.includes(role)) return element("span", { class: "key dashed", style: `border-color: ${colour}` });
  return element("span", { class: "key", style: `border-color: ${colour}; background: ${colour}` });
}
