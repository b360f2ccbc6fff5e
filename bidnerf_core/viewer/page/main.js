// Puts the page together: state, keys, slider, and what a server adds if there is one.
import { colourOf, element, find, lengthText } from "./data.js";
import { Space } from "./space.js";
import { Comparison } from "./compare.js";
import { explanations, figures, outcomeOf, poseText, uncertainty } from "./panel.js";
import { Results } from "./table.js";
import { Track } from "./track.js";
import { Live } from "./live.js";

const LAYERS = [["surface", "Surface", "s"], ["splats", "Splats", "x"], ["landmarks", "Landmarks", "l"], ["cameras", "Cameras", "c"], ["ellipsoid", "Ellipsoid", "e"]];
const KEYS = [["← →", "step of the search"], ["space", "play the search"], ["n p", "next, previous image"], ["1 … 6", "way of comparing"],
  ["w W", "wipe"], ["f", "whole map"], ["g", "go to the pose"], ["o", "from the photo"], ["r", "runner-up"],
  ["s x l c e", "surface, splats, landmarks, cameras, ellipsoid"], ["v", "field from here (live)"]];
const ENLARGED = [1, 10, 100, 1000];

class Page {
  constructor(state) {
    Object.assign(this, { state, map: state.map, answers: state.answers, current: -1, step: 0, runner: false, hidden: new Set(), factor: 1 });
    this.comparison = new Comparison();
    document.title = state.title || `${this.map.name} – bidnerf view`;
    find("title").textContent = this.map.name;
    for (const [name, value] of this.map.facts) find("facts").append(element("dt", {}, name), element("dd", {}, value));
    for (const [key, what] of KEYS) find("keys").append(element("dt", {}, element("kbd", {}, key)), element("dd", {}, what));
    try { this.space = new Space(find("space"), this.map); } catch (error) { this.note("This browser shows no WebGL; the pictures and figures beside are complete."); }
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
    this.follow();
    this.offerViews();
  }

  offerViews() { for (const id of ["go", "from"]) find(id).hidden = !this.pose; }

  placeOf(name) { return this.answers.findIndex((answer) => answer.name === name); }

  // Show the frame that the address names.
  follow() {
    if (!location.hash.startsWith("#frame=")) return;
    const name = decodeURIComponent(location.hash.slice(7)), place = this.placeOf(name);
    if (place < 0) this.results?.chooseFrame(name); else if (place !== this.current) this.select(place);
  }

  // Show the frame of a row: its answer where there is one, else the pose of the row, which a server may localize anew.
  goToRow(row) {
    const place = this.placeOf(row.frame), number = this.live?.queries.indexOf(row.frame) ?? -1;
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
    find("answer").replaceChildren(...outcomeOf(answer), element("p", { class: "empty" }, row.sigma === null ? "" : `Standard deviation of the position: ${lengthText(row.sigma, this.map.unit)}.`));
    this.space?.clear("answer");
    this.space?.frustum("answer", row.pose, this.map.cameras[0]?.shape, colourOf(row.accepted ? "--good" : "--bad"));
    this.space?.near(row.pose);
  }

  note(text) { find("note").textContent = text; }

  empty() {
    find("answer").replaceChildren(
      element("p", { class: "empty" }, this.state.live ? "Choose a photo or drop it on the map to find where it was taken."
        : this.track || this.results ? "" : "The page holds no localization."));
  }

  buttons() {
    const toggle = (name, label, key) => element("button", { id: `show-${name}`, "aria-pressed": String(!this.hidden.has(name)), title: `${label} (${key})`,
      onclick: () => this.toggle(name) }, label);
    find("toggles").append(...LAYERS.filter(([name]) => name === "ellipsoid" ? this.answers.length || this.state.live : this.map[name] && (name !== "cameras" || this.map.cameras.length))
      .map((each) => toggle(...each)));
    find("views").append(element("button", { id: "fit", title: "Whole map (f)", onclick: () => this.fit() }, "Whole map"),
      element("button", { id: "go", title: "Go to the pose (g)", onclick: () => this.go() }, "Pose"),
      element("button", { id: "from", title: "From the photo (o)", onclick: () => this.from() }, "From the photo"));
  }

  toggle(name) {
    if (!find(`show-${name}`)) return;
    if (!this.hidden.delete(name)) this.hidden.add(name);
    find(`show-${name}`).setAttribute("aria-pressed", String(!this.hidden.has(name)));
    if (name === "ellipsoid") this.drawAnswer(); else this.space?.show(name, !this.hidden.has(name));
  }

  get answer() { return this.answers[this.current]; }

  get pose() { return this.runner && this.answer?.runner_up ? this.answer.runner_up.pose : this.answer?.pose; }

  fit() { this.space?.fit(); }

  go() { if (this.pose) this.space?.near(this.pose); }

  from() { if (this.pose) this.space?.from(this.pose, this.answer.shape); }

  list() {
    const select = find("query"), many = this.answers.length > 1;
    find("queries").hidden = !many && !this.live?.queries?.length;
    select.replaceChildren(...this.answers.map((answer, i) =>
      element("option", { value: String(i) }, `${answer.accepted ? "✓" : "✗"} ${answer.name}`)));
    this.live?.listQueries(select);
    if (this.current >= 0) select.value = String(this.current);
  }

  listen() {
    find("query").addEventListener("change", (event) => {
      const value = event.target.value;
      if (value.startsWith("query ")) this.live.localizeQuery(Number(value.slice(6))); else this.select(Number(value));
    });
    find("previous").addEventListener("click", () => this.turn(-1));
    find("next").addEventListener("click", () => this.turn(1));
    find("step").addEventListener("input", (event) => this.showStep(Number(event.target.value)));
    find("play").addEventListener("click", () => this.play());
    find("space").addEventListener("pointermove", (event) => this.hover(event));
    find("space").addEventListener("pointerdown", (event) => this.hover(event));
    find("space").addEventListener("pointerleave", () => { find("card").hidden = true; });
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("hashchange", () => this.follow());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.drawAnswer());
  }

  // Show what the camera of the map under the pointer sees.
  hover(event) {
    const card = find("card"), box = event.target.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const number = event.type === "pointermove" && event.buttons ? -1 : this.space?.cameraAt(x, y) ?? -1;
    card.hidden = number < 0;
    if (number < 0) return;
    const { name, thumbnail } = this.map.cameras[number], url = thumbnail?.url ?? this.live?.thumbnail(number);
    card.replaceChildren(...(url ? [element("img", { src: url, alt: "" })] : []), name);
    card.style.left = `${Math.min(x + 12, box.width - 150)}px`;
    card.style.top = `${Math.min(y + 12, box.height - 130)}px`;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.key !== "Escape") return;
    const wipe = document.getElementById("wipe");
    const move = (by) => { if (wipe) { wipe.value = Number(wipe.value) + by; wipe.dispatchEvent(new Event("input")); } };
    const actions = {
      ArrowLeft: () => this.showStep(this.step - 1), ArrowRight: () => this.showStep(this.step + 1), " ": () => this.play(),
      n: () => this.turn(1), p: () => this.turn(-1), f: () => this.fit(), g: () => this.go(), o: () => this.from(), r: () => this.toggleRunner(),
      w: () => move(5), W: () => move(-5), v: () => this.live?.toggleField(), "?": () => { find("help").open = !find("help").open; },
      Escape: () => { find("help").open = find("about").open = false; },
    };
    for (const [name, , key] of LAYERS) actions[key] = () => this.toggle(name);
    if (/^[1-6]$/.test(event.key)) this.comparison.choose(["Wipe", "Blink", "Difference", "Edges", "Depth", "Matches"][event.key - 1]);
    else if (actions[event.key] && !(event.key === " " && event.target.tagName === "BUTTON")) { actions[event.key](); event.preventDefault(); }
  }

  turn(by) {
    if (this.live?.turn(by)) return;
    if (this.answers.length) this.select((this.current + by + this.answers.length) % this.answers.length);
  }

  add(answer) {
    const place = this.placeOf(answer.name);
    if (place < 0) this.answers.push(answer); else this.answers[place] = answer;
    this.list();
    this.select(place < 0 ? this.answers.length - 1 : place);
  }

  select(place, remember = true) {
    this.stop();
    const fresh = this.current !== place;
    this.current = place;
    if (fresh) this.runner = false;
    find("query").value = String(place);
    if (remember && location.protocol !== "about:") history.replaceState(null, "", `#frame=${encodeURIComponent(this.answer.name)}`);
    const { ellipsoid, steps } = this.answer;
    const size = this.space?.size ?? 1;
    this.factor = ellipsoid ? ENLARGED.find((factor) => factor * ellipsoid.lengths[0] >= 0.3 * size) ?? 1000 : 1;
    find("timeline").hidden = steps.length < 2;
    find("step").max = String(Math.max(0, steps.length - 1));
    this.step = Math.max(0, steps.length - 1);
    this.drawPanel();
    this.showStep(this.step);
    this.drawAnswer();
  }

  drawPanel() {
    const answer = this.answer, other = answer.runner_up;
    const runner = other ? element("button", { id: "runner", "aria-pressed": String(this.runner), onclick: () => this.toggleRunner(), title: "Runner-up (r)" },
      this.runner ? "Back to the pose found" : "Show the runner-up") : null;
    const sizes = ENLARGED.map((factor) => element("option", { value: String(factor), selected: factor === this.factor }, `× ${factor}`));
    const enlarge = answer.ellipsoid ? element("p", { class: "row small" }, "Ellipsoid drawn", element("select", { id: "enlarge", "aria-label": "Size of the ellipsoid",
      onchange: (event) => { this.factor = Number(event.target.value); this.drawAnswer(); this.drawPanel(); } }, ...sizes)) : null;
    this.comparison.show({ ...answer, rendered: this.runner ? other?.rendered : answer.rendered, label: this.runner ? "runner-up" : "rendered",
      depth: this.runner ? null : answer.depth });
    const allPassed = answer.figures.every((figure) => figure.passed !== false);  // then an explanation tells why it was refused
    find("answer").replaceChildren(...outcomeOf(answer), this.comparison.root,
      ...(runner ? [element("p", { class: "row" }, runner, element("span", { class: "small" }, other.reason))] : []),
      ...(allPassed && !answer.accepted ? [...explanations(answer), ...figures(answer)] : [...figures(answer), ...explanations(answer)]), ...uncertainty(answer, this.factor), ...(enlarge ? [enlarge] : []), ...poseText(answer).filter(Boolean));
  }

  toggleRunner() {
    if (!this.answer?.runner_up) return;
    this.runner = !this.runner;
    this.drawPanel();
    this.drawAnswer();
  }

  showStep(step) {
    const steps = this.answer?.steps ?? [];
    if (!steps.length) return;
    this.step = Math.max(0, Math.min(steps.length - 1, step));
    find("step").value = String(this.step);
    find("caption").textContent = `${this.step + 1} of ${steps.length}: ${steps[this.step].caption}`;
    find("caption").title = steps[this.step].caption;
    if (this.step < steps.length - 1) this.space?.hypotheses(steps[this.step], this.answer.shape); else this.space?.clear("search");
  }

  play() {
    if (this.playing) { this.stop(); return; }
    const steps = this.answer?.steps ?? [];
    if (steps.length < 2) return;
    if (this.step >= steps.length - 1) this.showStep(0);
    find("play").textContent = "❚❚";
    this.playing = setInterval(() => { this.showStep(this.step + 1); if (this.step >= steps.length - 1) this.stop(); }, 900);
  }

  stop() { clearInterval(this.playing); this.playing = null; find("play").textContent = "▶"; }

  drawAnswer() {
    this.offerViews();
    const { space, answer } = this;
    if (!space || !answer) return;
    space.clear("answer");
    const button = find("show-ellipsoid");
    if (button) button.textContent = this.factor > 1 && answer.ellipsoid ? `Ellipsoid × ${this.factor}` : "Ellipsoid";
    if (!answer.pose) return;
    const colour = colourOf(answer.accepted ? "--good" : "--bad");
    space.frustum("answer", answer.pose, answer.shape, colour, { picture: answer.observed?.url });
    space.axes("answer", answer.pose, 0.4 * space.size);
    if (answer.ellipsoid && !this.hidden.has("ellipsoid")) space.ellipsoid("answer", answer.pose, answer.ellipsoid.axes, this.factor, colour);
    if (answer.path.length > 1) space.lines("answer", answer.path, colour, { strip: true });
    if (answer.truth) space.frustum("answer", answer.truth, answer.shape, colourOf("--soft"), { depth: 0.9 * space.size, opacity: 0.7 });
    if (this.runner) space.frustum("answer", answer.runner_up.pose, answer.shape, colourOf("--accent"), { picture: answer.runner_up.rendered?.url });
  }
}

window.page = new Page(JSON.parse(find("state").textContent));
