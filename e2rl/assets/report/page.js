// The page: what is shown of the report, and how its parts work together.

class Page {
  constructor(report) {
    this.report = report;
    report.failures.forEach((failure, number) => {
      failure.number = number;
    });
    this.store = new Store(report);
    this.player = new Player(this.store, (direction) => this.open(this.index.neighbour(direction)));
    this.index = new Index((failure) => this.open(failure), report.modes);
    showTables(document.getElementById("tables"), report.tables);
    showAbout(document.getElementById("about"), report.about);
    const { command, git } = report.run;
    document.getElementById("origin").textContent = `Made from: ${command}${git ? ` (commit ${git})` : ""}`;
    this.buildScope();
    this.buildAxes();
    onPaletteChange(() => {
      this.player.repaint();
      repaintModes(document.getElementById("modes"), this.modes);
    });
    this.choose(report.groups[0].ego);
    const linked = report.failures[Number(location.hash.slice(1)) - 1];
    if (linked) this.open(linked);
  }

  /** Selects of the planner, where there are several, and of its traffic. */
  buildScope() {
    const egos = [...new Set(this.report.groups.map(({ ego }) => ego))];
    const scope = document.getElementById("scope");
    if (egos.length > 1)
      scope.append(
        choice(
          "Planner",
          egos.map((ego) => [ego, ego]),
          (ego) => this.choose(ego),
        ),
      );
    this.traffic = choice("Traffic", [], (index) => this.show(index === "" ? this.groups : [this.groups[index]]));
    scope.append(this.traffic);
  }

  buildAxes() {
    this.axes = { rate: "cfr", realism: "real" };
    const pick = (name, label, options) =>
      choice(label, Object.entries(options), (value) => {
        this.axes[name] = value;
        this.showRealism();
      });
    document.getElementById("axes").append(pick("rate", "Upwards", RATES), pick("realism", "To the right", REALISMS));
  }

  /** Show a planner in all its traffic. */
  choose(ego) {
    this.ego = ego;
    this.groups = this.report.groups.filter((group) => group.ego === ego);
    document.getElementById("ego-name").textContent = ego;
    const options = [
      ["", "all"],
      ...this.groups.map(({ label, failures }, index) => [index, `${label} (${failures} failures)`]),
    ];
    this.traffic
      .querySelector("select")
      .replaceChildren(...options.map(([value, text]) => element("option", { value }, text)));
    this.traffic.hidden = this.groups.length < 2;
    this.showRealism();
    this.show(this.groups);
  }

  showRealism() {
    const points = this.report.points.filter(({ ego }) => ego === this.ego);
    showRealism(document.getElementById("realism"), points, this.axes.rate, this.axes.realism);
  }

  /** Show the failures of some groups: their modes, the typical case of the first, the atlas, the index. */
  show(groups) {
    const among = (failure) =>
      groups.some(
        ({ ego, method, eta }) => failure.ego_policy === ego && failure.method === method && failure.eta === eta,
      );
    const failures = this.report.failures.filter(among);
    this.modes = groupByMode(failures, this.report.modes);
    this.summarise(failures, groups);
    this.index.load(failures);
    showModes(document.getElementById("modes"), this.modes, failures.length, this.store, (mode) => this.openMode(mode));
    const atlas = groupByCell(failures, this.report.cells);
    showAtlas(document.getElementById("atlas"), atlas, (failure) => this.open(failure));
    document.getElementById("player").hidden = !failures.length;
    if (failures.length) this.open(this.modes[0].typical);
  }

  summarise(failures, groups) {
    const rollouts = groups.reduce((sum, group) => sum + group.rollouts, 0);
    const traffic = groups.length === 1 ? ` in ${groups[0].label}` : "";
    const named = this.modes.filter(({ mode, counted }) => mode !== OTHER && counted > 0).length;
    const { dataset, split, n_scenes: scenes, n_seeds: seeds } = this.report.run;
    const counted = meanOf(failures, "counted");
    document.getElementById("modes-title").textContent = failures.length
      ? `Its ${named} weakness${named === 1 ? "" : "es"}`
      : "No failure found";
    document.getElementById("summary").textContent =
      `${failures.length} failures in ${rollouts} rollouts${traffic} (${percent(failures.length / rollouts)})` +
      `${counted === null ? "" : `; ${percent(counted)} count: the ego's fault, or a competent driver prevents it`}. ` +
      `${dataset}/${split}, ${scenes} scenes, ${seeds} seed${seeds === 1 ? "" : "s"}.`;
  }

  /** Show the typical case of a mode, and its failures in the index. */
  openMode(mode) {
    this.index.chooseMode(mode.mode);
    this.open(mode.typical);
    if (matchMedia("(max-width: 900px)").matches) document.getElementById("player").scrollIntoView();
  }

  open(failure) {
    if (!failure) return;
    history.replaceState(null, "", `#${failure.number + 1}`);
    this.index.mark(failure);
    const buttons = document.querySelectorAll(".mode");
    this.modes.forEach(({ mode }, index) => buttons[index].setAttribute("aria-pressed", String(mode === failure.mode)));
    markCell(document.getElementById("atlas"), failure);
    this.player.show(failure, capital(modeName(failure.mode, this.report.modes)));
  }
}

const page = new Page(JSON.parse(document.getElementById("report").textContent));
