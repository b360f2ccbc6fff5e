// Puts the page together: state, keys, slider, and what a server adds if there is one.
import { colourOf, element, find, lengthText, percent, withCode } from "./data.js";
import { Space } from "./space.js";
import { Comparison } from "./compare.js";
import { contests, figures, outcomeOf, poseText, uncertainty } from "./panel.js";
import { Results } from "./table.js";
import { Track } from "./track.js";
import { Live } from "./live.js";

const LAYERS = [
  ["surface", "Surface", "s"],
  ["splats", "Splats", "x"],
  ["landmarks", "Landmarks", "l"],
  ["cameras", "Cameras", "c"],
  ["ellipsoid", "Ellipsoid", "e"],
];
// Words, and whether an answer uses them.
const WORDS = [
  ["accepted, refused", "whether the pose passed all tests; a refused one is shown so that you see why", () => true],
  ["field", "the trained radiance field, which is rendered", () => true],
  ["surface", "points of the field's surface (surfels), on which poses are searched", () => true],
  ["landmark", "a point of the map that is recognised by its looks", () => true],
  ["rendered", "what the map shows from the pose", (a) => a.rendered],
  ["runner-up", "the best pose that differs from the one found; called likelier if it is", (a) => a.runner_up],
  ["confidence", "probability that the pose is right", (a) => a.figures.some(({ name }) => name === "confidence")],
  ["ellipsoid", "where the camera is: two standard deviations of the position", (a) => a.ellipsoid],
];
const SWATCHES = { landmarks: "var(--landmark)", cameras: "var(--soft)" }; // colours in which layers are drawn
const ENLARGED = [1, 10, 100, 1000],
  GALLERY = 24; // sizes of the ellipsoid, and most images of the map that are shown

const placeOf = (pose) => [pose[3], pose[7], pose[11]];
const between = (one, other) => Math.hypot(...one.map((x, i) => x - other[i]));

class Page {
  constructor(state) {
    Object.assign(this, {
      state,
      map: state.map,
      answers: state.answers,
      current: -1,
      step: 0,
      runner: false,
      hidden: new Set(),
      factor: 1,
      look: "fit",
    });
    this.comparison = new Comparison();
    document.title = state.title || `${this.map.name} – bidnerf view`;
    find("title").textContent = this.map.name;
    for (const [name, value] of this.map.facts) find("facts").append(element("dt", {}, name), element("dd", {}, value));
    try {
      this.space = new Space(find("space"), this.map);
    } catch {
      this.note("This browser shows no WebGL; the pictures and figures beside are complete.");
    }
    this.hidden.add("landmarks");
    if (this.map.splats && this.map.surface) this.hidden.add("surface");
    this.space?.show("surface", !this.hidden.has("surface"));
    this.space?.show("landmarks", !this.map.surface);
    if (!this.map.surface) this.hidden.delete("landmarks");
    this.buttons();
    this.listen();
    this.live = state.live ? new Live(this) : null;
    this.list();
    this.track = state.trajectory ? new Track(this, state.trajectory) : null;
    this.results = state.results.length ? new Results(this, state.results) : null;
    if (this.answers.length) this.select(0, false);
    else this.empty();
    this.gallery();
    this.follow();
    this.offerViews();
  }

  // The words and the keys that have a use on this page as it is now.
  fillHelp() {
    const any = (has) => this.answers.some(has),
      pose = any((a) => a.pose),
      compared = any((a) => a.observed && a.rendered);
    const layers = LAYERS.filter(([name]) => find(`show-${name}`)?.hidden === false),
      ways = this.answer ? this.comparison.available().length : 0;
    const keys = [
      [any((a) => a.steps.length > 1), "← →", "step of the search"],
      [any((a) => a.steps.length > 1), "space", "play the search"],
      [this.answers.length > 1 || this.live?.queries.length > 1, "n p", "next, previous image"],
      [ways > 1, `1 … ${ways}`, "way of comparing"],
      [compared, "w W", "wipe"],
      [this.space, "f", "whole map"],
      [this.space, "m", "measure a distance"],
      [pose, "g", "go to the pose"],
      [pose, "o", "from the photo"],
      [any((a) => a.runner_up), "r", "runner-up"],
      [
        layers.length,
        layers.map(([, , key]) => key).join(" "),
        layers.map(([, label]) => label.toLowerCase()).join(", "),
      ],
      [this.live, "v", "field from here"],
    ];
    const outcomes = new Map(this.answers.filter((a) => a.meaning).map((a) => [a.outcome, a.meaning]));
    const methods = new Map(
      this.answers.filter((a) => a.method_summary).map((a) => [`method ${a.method}`, a.method_summary]),
    );
    const rows = (pairs, made) =>
      pairs.flatMap(([name, what]) => [element("dt", {}, made(name)), element("dd", {}, ...withCode(what))]);
    find("words").replaceChildren(
      ...rows([...outcomes, ...methods, ...WORDS.filter(([, , use]) => use.length === 0 || any(use))], (name) => name),
    );
    find("keys").replaceChildren(
      ...rows(
        keys.filter(([use]) => use).map(([, key, what]) => [key, what]),
        (key) => element("kbd", {}, key),
      ),
    );
  }

  offerViews() {
    this.offerEllipsoid();
    for (const id of ["go", "from"]) find(id).hidden = !this.pose;
  }

  placeOf(name) {
    return this.answers.findIndex((answer) => answer.name === name);
  }

  // Show the frame that the address names.
  follow() {
    if (!location.hash.startsWith("#frame=")) return;
    const name = decodeURIComponent(location.hash.slice(7)),
      place = this.placeOf(name);
    if (place < 0) this.results?.chooseFrame(name);
    else if (place !== this.current) this.select(place);
  }

  // Show the frame of a row: its answer where there is one, else the pose of the row, which a server may localize anew.
  goToRow(row) {
    const place = this.placeOf(row.frame),
      number = this.live?.queries.indexOf(row.frame) ?? -1;
    if (place >= 0) this.select(place);
    else if (number >= 0) this.live.localizeQuery(number);
    else if (row.pose) this.showRow(row);
    this.note(place >= 0 || number >= 0 ? "" : `${row.frame}: ${row.reason}`);
  }

  showRow(row) {
    this.runner = false;
    this.current = -1;
    find("timeline").hidden = true;
    this.space?.clear("search");
    const answer = { ...row, name: row.frame, seconds: 0, unit: this.map.unit };
    find("verdict").replaceChildren(...outcomeOf(answer));
    find("answer").replaceChildren(
      element(
        "p",
        { class: "empty" },
        row.sigma === null ? "" : `Standard deviation of the position: ${lengthText(row.sigma, this.map.unit)}.`,
      ),
    );
    this.space?.clear("answer");
    this.space?.frustum("answer", row.pose, this.map.cameras[0]?.shape, colourOf(row.accepted ? "--good" : "--bad"));
    this.space?.near(row.pose);
    this.offerViews();
  }

  note(...parts) {
    find("note").replaceChildren(...parts);
  }

  // What is being done at the moment; nothing if the text is empty.
  progress(text) {
    find("doing").textContent = text;
    find("progress").hidden = !text;
  }

  empty() {
    find("answer").replaceChildren(
      ...(this.state.live
        ? [
            element("p", { class: "lead" }, "Where was a photo taken?"),
            element(
              "p",
              {},
              "Drop it anywhere on this page, or ",
              element("label", { class: "button", for: "photo" }, "choose a photo"),
              " to find its pose in this map, with the reason why it is accepted or refused.",
            ),
          ]
        : this.track || this.results
          ? []
          : [element("p", { class: "empty" }, "The page holds no localization.")]),
    );
  }

  // Images of the map, spread over all or, at a click, all of them, from whose cameras one can look.
  gallery(most = GALLERY) {
    const known = this.map.cameras
      .map((camera, i) => [camera, i, camera.thumbnail?.url ?? this.live?.thumbnail(i)])
      .filter(([, , url]) => url);
    const every = Math.max(1, Math.ceil(known.length / most));
    find("seen").hidden = !known.length;
    find("gallery").replaceChildren(
      ...known
        .filter((_, i) => i % every === 0)
        .map(([{ name }, i, url]) =>
          element(
            "button",
            { title: name, onclick: () => this.lookFrom(i) },
            element("img", { src: url, alt: name, loading: "lazy" }),
          ),
        ),
      ...(every > 1
        ? [element("button", { class: "more", onclick: () => this.gallery(known.length) }, `all ${known.length}`)]
        : []),
    );
  }

  lookFrom(number) {
    const { name, pose, shape } = this.map.cameras[number];
    this.space?.from(pose, shape);
    this.note(`The map from the camera of ${name}`);
  }

  // Two points to pick, whose distance tells the scale of the map.
  measure() {
    this.measured = this.measured ? null : [];
    this.space?.clear("measure");
    find("measure").setAttribute("aria-pressed", String(Boolean(this.measured)));
    find("stage").classList.toggle("measuring", Boolean(this.measured));
    this.note(this.measured ? "Click two points of the surface whose distance you know." : "");
  }

  pick(x, y) {
    const place = this.space.pointAt(x, y),
      colour = colourOf("--accent");
    if (!place) {
      this.note("There is no point of the map; click on its surface.");
      return;
    }
    this.measured = [...(this.measured.length > 1 ? [] : this.measured), place];
    this.space.clear("measure");
    this.space.dots(
      "measure",
      this.measured,
      this.measured.map(() => [0.12, 0.37, 0.75]),
      0.05 * this.space.size,
    );
    if (this.measured.length < 2) {
      this.note("Now the second point.");
      return;
    }
    const length = between(...this.measured),
      command = element("code"),
      real = element("input", { type: "number", min: "0", step: "any", "aria-label": "True distance in metres" });
    this.space.lines("measure", this.measured, colour);
    this.space.label("measure", this.measured[1], lengthText(length, this.map.unit), colour);
    const say = () => {
      command.textContent =
        real.value > 0 ? `bidnerf scale MAP --factor ${Number((real.value / length).toPrecision(5))}` : "";
    };
    real.addEventListener("input", say);
    this.note(`${lengthText(length, this.map.unit)}. In truth it is `, real, " m: ", command);
  }

  buttons() {
    const toggle = (name, label, key) =>
      element(
        "button",
        {
          id: `show-${name}`,
          "aria-pressed": String(!this.hidden.has(name)),
          title: `${label} (${key})`,
          onclick: () => this.toggle(name),
        },
        ...(name in SWATCHES ? [element("i", { class: "dot", style: `background:${SWATCHES[name]}` })] : []),
        label,
      );
    find("toggles").append(
      ...LAYERS.filter(([name]) =>
        name === "ellipsoid"
          ? this.answers.length || this.state.live
          : this.map[name] && (name !== "cameras" || this.map.cameras.length),
      ).map((each) => toggle(...each)),
    );
    find("views").append(
      element("button", { id: "fit", title: "Whole map (f)", onclick: () => this.fit() }, "Whole map"),
      element("button", { id: "go", title: "Go to the pose (g)", onclick: () => this.go() }, "Pose"),
      element("button", { id: "from", title: "From the photo (o)", onclick: () => this.from() }, "From the photo"),
      element(
        "button",
        { id: "measure", title: "Measure a distance (m)", "aria-pressed": "false", onclick: () => this.measure() },
        "Measure",
      ),
    );
  }

  toggle(name) {
    if (find(`show-${name}`)?.hidden !== false) return;
    if (!this.hidden.delete(name)) this.hidden.add(name);
    find(`show-${name}`).setAttribute("aria-pressed", String(!this.hidden.has(name)));
    if (name === "ellipsoid") this.drawAnswer();
    else this.space?.show(name, !this.hidden.has(name));
  }

  get answer() {
    return this.answers[this.current];
  }

  get pose() {
    return this.runner && this.answer?.runner_up ? this.answer.runner_up.pose : this.answer?.pose;
  }

  fit() {
    this.look = "fit";
    this.note("");
    this.space?.fit();
  }

  go() {
    if (this.pose) {
      this.look = "go";
      this.space?.near(this.pose);
    }
  }

  from() {
    if (this.pose) {
      this.look = "from";
      this.space?.from(this.pose, this.answer.shape);
    }
  }

  list() {
    const select = find("query"),
      many = this.answers.length > 1;
    find("queries").hidden = !many && !this.live?.queries?.length;
    select.replaceChildren(
      ...this.answers.map((answer, i) =>
        element("option", { value: String(i) }, `${answer.accepted ? "✓" : "✗"} ${answer.name}`),
      ),
    );
    this.live?.listQueries(select);
    if (this.current >= 0) select.value = String(this.current);
  }

  listen() {
    find("query").addEventListener("change", (event) => {
      const value = event.target.value;
      if (value.startsWith("query ")) this.live.localizeQuery(Number(value.slice(6)));
      else this.select(Number(value));
    });
    find("previous").addEventListener("click", () => this.turn(-1));
    find("next").addEventListener("click", () => this.turn(1));
    find("step").addEventListener("input", (event) => this.showStep(Number(event.target.value)));
    find("play").addEventListener("click", () => this.play());
    find("space").addEventListener("pointermove", (event) => this.hover(event));
    find("space").addEventListener("pointerdown", (event) => {
      this.down = [event.clientX, event.clientY];
      this.hover(event);
    });
    find("space").addEventListener("pointerup", (event) => this.click(event));
    find("space").addEventListener("pointerleave", () => {
      find("card").hidden = true;
    });
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("hashchange", () => this.follow());
    find("help").addEventListener("toggle", () => this.fillHelp());
    addEventListener("pointerdown", ({ target }) => {
      if (!find("help").contains(target)) find("help").open = false;
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.drawAnswer();
      if (this.answer) this.showStep(this.step);
    });
  }

  // A click picks a point to measure, or looks from the camera under it; a drag does neither.
  click(event) {
    const box = event.target.getBoundingClientRect(),
      x = event.clientX - box.left,
      y = event.clientY - box.top;
    if (!this.space || Math.hypot(event.clientX - this.down?.[0], event.clientY - this.down?.[1]) > 4) return;
    const number = this.measured ? -1 : this.space.cameraAt(x, y);
    if (this.measured) this.pick(x, y);
    else if (number >= 0) this.lookFrom(number);
  }

  // Show what the camera of the map under the pointer sees.
  hover(event) {
    const card = find("card"),
      box = event.target.getBoundingClientRect(),
      x = event.clientX - box.left,
      y = event.clientY - box.top;
    const number = event.type === "pointermove" && event.buttons ? -1 : (this.space?.cameraAt(x, y) ?? -1);
    card.hidden = number < 0;
    if (number < 0) return;
    const { name, thumbnail } = this.map.cameras[number],
      url = thumbnail?.url ?? this.live?.thumbnail(number);
    card.replaceChildren(...(url ? [element("img", { src: url, alt: "" })] : []), name);
    card.style.left = `${Math.min(x + 12, box.width - 150)}px`;
    card.style.top = `${Math.min(y + 12, box.height - 130)}px`;
  }

  key(event) {
    if (
      event.ctrlKey ||
      event.metaKey ||
      event.altKey ||
      (/^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.key !== "Escape")
    )
      return;
    const wipe = document.getElementById("wipe");
    const move = (by) => {
      if (wipe) {
        wipe.value = Number(wipe.value) + by;
        wipe.dispatchEvent(new Event("input"));
      }
    };
    const actions = {
      ArrowLeft: () => this.showStep(this.step - 1),
      ArrowRight: () => this.showStep(this.step + 1),
      " ": () => this.play(),
      n: () => this.turn(1),
      p: () => this.turn(-1),
      f: () => this.fit(),
      g: () => this.go(),
      o: () => this.from(),
      r: () => this.toggleRunner(),
      w: () => move(5),
      W: () => move(-5),
      v: () => this.live?.toggleField(),
      m: () => this.measure(),
      "?": () => {
        find("help").open = !find("help").open;
      },
      Escape: () => {
        find("help").open = false;
        if (this.measured) this.measure();
      },
    };
    for (const [name, , key] of LAYERS) actions[key] = () => this.toggle(name);
    if (/^[1-6]$/.test(event.key)) this.comparison.choose(this.answer && this.comparison.available()[event.key - 1]);
    else if (actions[event.key] && !(event.key === " " && event.target.tagName === "BUTTON")) {
      actions[event.key]();
      event.preventDefault();
    }
  }

  turn(by) {
    if (this.live?.turn(by)) return;
    if (this.answers.length) this.select((this.current + by + this.answers.length) % this.answers.length);
  }

  add(answer) {
    const place = this.placeOf(answer.name);
    if (place < 0) this.answers.push(answer);
    else this.answers[place] = answer;
    this.list();
    this.select(place < 0 ? this.answers.length - 1 : place);
  }

  select(place, remember = true) {
    this.stop();
    const fresh = this.current !== place;
    this.current = place;
    if (fresh) this.runner = false;
    find("query").value = String(place);
    if (remember && location.protocol !== "about:")
      history.replaceState(null, "", `#frame=${encodeURIComponent(this.answer.name)}`);
    const { ellipsoid, steps } = this.answer;
    const size = this.space?.size ?? 1,
      { answer } = this;
    this.space?.frame(
      [answer.pose, answer.truth, answer.runner_up?.pose].filter(Boolean).map(placeOf).concat(answer.path.slice(0, 1)),
    );
    this.factors = ENLARGED.filter((factor) => factor === 1 || factor * ellipsoid?.lengths[0] <= 10 * size); // none far beyond the view
    this.factor = this.factors.find((factor) => factor * ellipsoid?.lengths[0] >= 0.3 * size) ?? this.factors.at(-1);
    find("timeline").hidden = steps.length < 2;
    find("step").max = String(Math.max(0, steps.length - 1));
    this.step = Math.max(0, steps.length - 1);
    this.drawPanel();
    this.showStep(this.step);
    this.drawAnswer();
  }

  drawPanel() {
    const answer = this.answer,
      other = answer.runner_up,
      name = this.otherName;
    const runner = other
      ? element(
          "p",
          { class: this.runner ? "row banner" : "row" },
          this.runner ? element("b", {}, `You are looking at the ${name}`) : null,
          element(
            "button",
            {
              id: "runner",
              "aria-pressed": String(this.runner),
              onclick: () => this.toggleRunner(),
              title: "Runner-up (r)",
            },
            this.runner ? "Back to the pose found" : `Show the ${name}`,
          ),
          element("span", { class: "small" }, this.aboutOther),
        )
      : null;
    const sizes = this.factors.map((factor) =>
      element("option", { value: String(factor), selected: factor === this.factor }, `× ${factor}`),
    );
    const enlarge = answer.ellipsoid
      ? element(
          "p",
          { class: "row small" },
          "Ellipsoid drawn",
          element(
            "select",
            {
              id: "enlarge",
              "aria-label": "Size of the ellipsoid",
              onchange: (event) => {
                this.factor = Number(event.target.value);
                this.drawAnswer();
                this.drawPanel();
              },
            },
            ...sizes,
          ),
        )
      : null;
    this.comparison.show(
      this.runner ? { ...answer, rendered: other.rendered, label: name, depth: null, matches: null } : answer,
    );
    const compared = contests(answer, true),
      measured = figures(answer);
    const parts = this.runner
      ? compared
      : [
          ...(answer.accepted ? [...measured, ...compared] : [...compared, ...measured]),
          ...contests(answer, false),
          ...uncertainty(answer, this.factor),
          enlarge,
        ];
    find("verdict").replaceChildren(...outcomeOf(answer));
    find("answer").replaceChildren(
      ...[
        this.runner ? runner : null,
        this.comparison.root,
        this.runner ? null : runner,
        ...parts,
        ...poseText(answer, this.pose),
      ].filter(Boolean),
    );
  }

  get otherName() {
    return this.answer.runner_up?.probability > 0.5 ? "likelier pose" : "runner-up";
  }

  // How far the runner-up is from the pose found, and both from where the map was seen.
  get aboutOther() {
    const { pose, runner_up: other, unit, reason } = this.answer,
      [here, there] = [pose, other.pose].map(placeOf),
      seen = this.map.cameras;
    const nearest = (place) =>
      lengthText(Math.min(...seen.map((camera) => between(place, placeOf(camera.pose)))), unit);
    return (
      `${lengthText(between(here, there), unit)} from the pose found${reason.includes(other.reason) ? "" : `: ${other.reason}`}.` +
      (other.probability !== null && seen.length
        ? ` The nearest camera of the map is ${nearest(there)} from it, and ${nearest(here)} from the pose found.`
        : "")
    );
  }

  toggleRunner() {
    if (!this.answer?.runner_up) return;
    this.runner = !this.runner;
    this.drawPanel();
    this.drawAnswer();
    if (this.look === "from") this.from();
    else this.go();
  }

  showStep(step) {
    const steps = this.answer?.steps ?? [];
    if (!steps.length) return;
    this.step = Math.max(0, Math.min(steps.length - 1, step));
    find("step").value = String(this.step);
    const { caption, loss, scores } = steps[this.step],
      last = this.step === steps.length - 1;
    const text = loss === null || last ? caption : `${caption}: loss ${Number(loss.toPrecision(3))}`;
    find("caption").textContent = loss === null ? `${this.step + 1} of ${steps.length}: ${text}` : text;
    find("caption").title = text;
    find("scores").hidden = last || scores.length < 2;
    this.drawLosses(steps);
    if (last) this.space?.clear("search");
    else this.space?.hypotheses(steps[this.step], this.answer.shape);
  }

  // The losses of a descent, from the least to the greatest, with a mark at the present step.
  drawLosses(steps) {
    const known = steps.map(({ loss }) => loss),
      svg = find("losses"),
      most = Math.max(...known),
      least = Math.min(...known);
    svg.toggleAttribute(
      "hidden",
      known.some((loss) => loss === null),
    );
    if (svg.hasAttribute("hidden")) return;
    const at = (i) => [(100 * i) / (known.length - 1), 28 - (26 * (known[i] - least)) / (most - least || 1)];
    svg.querySelector("polyline").setAttribute("points", known.map((_, i) => at(i).join()).join(" "));
    const [x, y] = at(this.step),
      line = svg.querySelector("line");
    for (const [name, value] of [
      ["x1", x],
      ["x2", x],
      ["y1", y],
      ["y2", 30],
    ])
      line.setAttribute(name, value);
  }

  play() {
    if (this.playing) {
      this.stop();
      return;
    }
    const steps = this.answer?.steps ?? [];
    if (steps.length < 2) return;
    if (this.step >= steps.length - 1) this.showStep(0);
    find("play").textContent = "❚❚";
    this.playing = setInterval(
      () => {
        this.showStep(this.step + 1);
        if (this.step >= steps.length - 1) this.stop();
      },
      Math.min(900, 10000 / steps.length),
    );
  }

  stop() {
    clearInterval(this.playing);
    this.playing = null;
    find("play").textContent = "▶";
  }

  offerEllipsoid() {
    const button = find("show-ellipsoid"),
      known = Boolean(this.answer?.ellipsoid);
    if (!button) return;
    button.textContent = this.factor > 1 ? `Ellipsoid × ${this.factor}` : "Ellipsoid";
    button.hidden = !known;
    button.setAttribute("aria-pressed", String(!this.hidden.has("ellipsoid")));
  }

  drawAnswer() {
    this.offerViews();
    const { space, answer } = this;
    if (!space || !answer) return;
    space.clear("answer");
    if (!answer.pose) return;
    const colour = colourOf(answer.accepted ? "--good" : "--bad");
    space.frustum("answer", answer.pose, answer.shape, colour, { picture: this.runner ? null : answer.observed?.url });
    space.axes("answer", answer.pose, 0.4 * space.size);
    if (answer.ellipsoid && !this.hidden.has("ellipsoid"))
      space.ellipsoid("answer", answer.pose, answer.ellipsoid.axes, this.factor, colour);
    const soft = colourOf("--soft"),
      accent = colourOf("--accent"),
      { runner_up: other, path } = answer;
    const likely = (p) => (p === undefined || p === null ? "" : ` (${percent(p)})`);
    space.label(
      "answer",
      placeOf(answer.pose),
      `${answer.accepted ? "pose found" : "pose found, refused"}${likely(other?.probability && 1 - other.probability)}`,
      colour,
    );
    if (path.length > 1) {
      space.lines("answer", path, colour, { strip: true });
      if (between(path[0], placeOf(answer.pose)) > space.size) space.label("answer", path[0], "start", colour);
    }
    if (answer.truth) {
      space.frustum("answer", answer.truth, answer.shape, soft, { depth: 0.9 * space.size, opacity: 0.7 });
      if (between(placeOf(answer.truth), placeOf(answer.pose)) > 0.5 * space.size)
        space.label("answer", placeOf(answer.truth), "true pose", soft);
    }
    if (other) {
      space.frustum("answer", other.pose, answer.shape, accent, {
        picture: this.runner ? answer.observed?.url : null,
        opacity: this.runner ? 1 : 0.6,
      });
      space.label("answer", placeOf(other.pose), `${this.otherName}${likely(other.probability)}`, accent);
    }
  }
}

window.page = new Page(JSON.parse(find("state").textContent));
