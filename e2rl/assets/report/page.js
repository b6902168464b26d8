// The page: what is shown of the report, and how its parts work together.

class Page {
  constructor(report) {
    this.report = report;
    this.store = new Store(report);
    this.player = new Player(this.store, (direction) => this.open(this.index.neighbour(direction)));
    this.index = new Index((failure) => this.open(failure), report.modes);
    showTables(document.getElementById("tables"), report.tables);
    this.showOutcomes(report.outcomes);
    showAbout(document.getElementById("about"), report.about);
    if (report.progress) this.showProgress(report.progress);
    const { command, git } = report.run;
    document.getElementById("origin").textContent = `Made from: ${command}${git ? ` (commit ${git})` : ""}`;
    this.buildScope();
    this.buildAxes();
    onPaletteChange(() => {
      this.player.repaint();
      for (const { picture, found } of [...this.cases, ...this.modes]) if (found) drawTypical(picture, found);
    });
    const asked = location.hash; // which `open` changes
    this.choose(report.groups[0].ego);
    addEventListener("hashchange", () => this.follow(location.hash));
    this.follow(asked);
  }

  /** What came nearest to a failure in each scene, where any is without one. */
  showOutcomes(outcomes) {
    document.getElementById("outcomes").hidden = !outcomes;
    if (!outcomes) return;
    document.getElementById("outcomes-table").replaceChildren(...sortedTable(outcomes, "Scene by scene"));
    document.getElementById("outcomes-caption").textContent = outcomes.caption;
  }

  /** Say how far a run is that goes on, and load the page again every so many seconds, but not amid a replay. */
  showProgress({ text, every }) {
    const notice = document.getElementById("progress");
    notice.textContent = text;
    notice.hidden = false;
    document.querySelector("section.realism").hidden = true; // it needs intervals
    if (every) setInterval(() => this.player.playing || location.reload(), 1000 * every);
  }

  /** Go to the summary, to the failure that the end of an address names, or to those of a planner in a traffic. */
  follow(hash) {
    const brief = hash === "#summary" && this.report.groups.some(({ plain }) => plain);
    const switched = document.body.classList.contains("brief") !== brief;
    document.body.classList.toggle("brief", brief);
    document.getElementById("summary").hidden = !brief;
    if (switched) scrollTo(0, 0);
    if (brief) history.replaceState(null, "", hash); // which `open` changed
    this.player.pause();
    const [, method, ego] = hash.match(/^#group=(.+)\/(.+)/)?.map(decodeURIComponent) ?? [];
    const chosen = this.report.groups.find((group) => group.ego === ego && group.method === method);
    if (chosen) {
      this.choose(ego);
      this.show(chosen);
      document.getElementById("scope").scrollIntoView();
      return;
    }
    const [, key] = hash.match(/^#failure=(.+)/) ?? [];
    const failure = this.report.failures.find((each) => [each.key, encodeURIComponent(each.key)].includes(key));
    document.getElementById("lost").hidden = !key || Boolean(failure);
    if (!failure) return;
    if (failure.ego_policy !== this.ego) this.choose(failure.ego_policy);
    this.show(this.groups.find((group) => isOf(failure, group)));
    this.open(failure);
    if (switched) document.getElementById("player").scrollIntoView();
  }

  /** Selects of the planner, where there are several, and of its traffic. */
  buildScope() {
    const egos = [...new Set(this.report.groups.map(({ ego }) => ego))];
    const scope = document.getElementById("scope");
    const named = egos.map((ego) => [ego, ego]);
    this.planner = choice("Planner", named, (ego) => this.choose(ego));
    this.planner.hidden = egos.length < 2;
    this.traffic = choice("Traffic", [], (index) => this.show(this.groups[index]));
    scope.append(this.planner, this.traffic);
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

  /** Show a planner: all its failures in the index, else those in the traffic that the run was about. */
  choose(ego) {
    this.ego = ego;
    this.planner.querySelector("select").value = ego;
    this.groups = this.report.groups.filter((group) => group.ego === ego);
    document.getElementById("ego-name").textContent = ego;
    const options = this.groups.map(({ label, failures, raised }) => {
      const found = [plural(failures, "contact"), raised && `${raised} raised`].filter(Boolean);
      return `${label} (${found.join(", ")})`;
    });
    this.traffic
      .querySelector("select")
      .replaceChildren(...options.map((text, value) => element("option", { value }, text)));
    this.traffic.hidden = this.groups.length < 2;
    this.showRealism();
    this.index.load(this.report.failures.filter((failure) => failure.ego_policy === ego));
    this.show(mainOf(this.groups));
  }

  showRealism() {
    const points = this.report.points.filter(({ ego }) => ego === this.ego);
    showRealism(document.getElementById("realism"), points, this.axes.rate, this.axes.realism);
  }

  /** Show the failures of a group: their modes, the typical case of the first, the atlas. */
  show(group) {
    const failures = this.report.failures.filter((failure) => isOf(failure, group));
    this.traffic.querySelector("select").value = this.groups.indexOf(group);
    this.modes = groupByMode(failures, this.report.modes);
    this.summarise(failures, group);
    this.cases = showSummary(group, this.modes, this.store, this.report.progress);
    showModes(document.getElementById("modes"), this.modes, failures.length, this.store, (mode) => this.openMode(mode));
    const atlas = groupByCell(failures, this.report.cells);
    showAtlas(document.getElementById("atlas"), atlas, (failure) => this.open(failure));
    document.getElementById("player").hidden = !failures.length;
    if (failures.length) this.open(failures.find(({ worst }) => worst) ?? this.modes[0].typical);
    showErrored(this.report.errored.filter((rollout) => isOf(rollout, group)));
  }

  /** The first lines: how often the planner fails in one traffic; rates of several are not pooled. */
  summarise(failures, { summary: [headline, ...lines] }) {
    const { dataset, split, n_scenes: scenes, stage } = this.report.run;
    lines.push(`${dataset}/${split}, ${scenes} scenes.`);
    document.getElementById("answer").replaceChildren(element("strong", {}, headline), ` ${lines.join(" ")}`);
    document.getElementById("stage").textContent = stage ? `, ${stage} training` : "";
    document.getElementById("modes-title").textContent = this.modesTitle(failures);
  }

  /** What the list of modes is called; a mode of which no failure counts is no weakness. */
  modesTitle(failures) {
    const named = this.modes.filter(({ mode, counted }) => mode !== OTHER && counted > 0).length;
    if (!failures.length) return "No contact found";
    if (named) return `Its ${named} weakness${named === 1 ? "" : "es"}`;
    return this.modes.some(({ counted }) => counted > 0) ? "No weakness stands out" : "None of its failures counts";
  }

  /** Show the typical case of a mode, and its failures in the index. */
  openMode(mode) {
    this.index.filterBy({ Mode: mode.mode, Traffic: trafficOf(mode.typical) });
    this.open(mode.typical);
    if (matchMedia("(max-width: 900px)").matches) document.getElementById("player").scrollIntoView();
  }

  open(failure) {
    if (!failure) return;
    history.replaceState(null, "", `#failure=${failure.key}`);
    const copies = Object.entries({ Link: `${location.href.split("#")[0]}#failure=@NAME@`, ...this.report.commands });
    const fields = copies.map(([label, text]) => copyField(label, text.replaceAll("@NAME@", failure.key)));
    const saves = (this.report.attached?.[failure.key] ?? []).map((file) => saveButton(failure, file));
    document.getElementById("copies").replaceChildren(...saves, ...fields);
    this.index.mark(failure);
    const buttons = document.querySelectorAll(".mode");
    this.modes.forEach(({ mode }, index) => buttons[index].setAttribute("aria-pressed", String(mode === failure.mode)));
    markCell(document.getElementById("atlas"), failure);
    this.player.show(failure, capital(modeName(failure.mode, this.report.modes)));
  }
}

/** The list of rollouts that errored, where there are any. */
function showErrored(rollouts) {
  const rows = rollouts.map(({ scene_id: scene, seed, raised_by: by, error }) => {
    const whose = by === "traffic" ? "the traffic's, left out" : "the planner's, a failure";
    return element("tr", {}, ...[scene, String(seed), error, whose].map((text) => element("td", {}, text)));
  });
  document.getElementById("errored").hidden = !rows.length;
  document.getElementById("errored-title").textContent = plural(rows.length, "rollout") + " without an end";
  document.getElementById("errored-rows").replaceChildren(...rows);
}

const isOf = (failure, { ego, method, eta }) =>
  failure.ego_policy === ego && failure.method === method && failure.eta === eta;

/** The group that the run was about: the search, else the first attack, at its highest intensity. */
function mainOf(groups) {
  const attacks = groups.filter(({ eta }) => eta > 0);
  const { method } = attacks.find((group) => group.method === "search") ?? attacks[0] ?? groups[0];
  return groups.filter((group) => group.method === method).reduce((most, each) => (each.eta > most.eta ? each : most));
}

const page = new Page(JSON.parse(document.getElementById("report").textContent));
