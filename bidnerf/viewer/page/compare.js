// The photo against the rendering: wipe, blink, difference, edges, depth, matches.
import { element, lengthText, numbers } from "./data.js";

const MODES = ["Wipe", "Blink", "Difference", "Edges", "Depth", "Matches"];
const SVG = "http://www.w3.org/2000/svg";

async function pixels(url, width, height) {
  const image = new Image();
  image.src = url;
  await image.decode();
  const canvas = element("canvas", { width, height }),
    context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0, width, height);
  return context.getImageData(0, 0, width, height);
}

function gradient({ data, width, height }) {
  const grey = new Float32Array(width * height),
    slope = new Float32Array(width * height);
  for (let i = 0; i < grey.length; i++) grey[i] = (data[4 * i] + data[4 * i + 1] + data[4 * i + 2]) / 765;
  for (let y = 1; y < height - 1; y++) {
    for (let x = 1; x < width - 1; x++) {
      const i = y * width + x;
      slope[i] = Math.hypot(grey[i + 1] - grey[i - 1], grey[i + width] - grey[i - width]);
    }
  }
  const bar = Math.max(0.05, [...slope].sort((a, b) => a - b)[Math.floor(0.9 * slope.length)]);
  return slope.map((value) => Math.max(0, Math.min(1, (value - 0.7 * bar) / (0.6 * bar))));
}

export class Comparison {
  constructor() {
    this.wanted = "Wipe";
    this.share = 50;
    this.gain = 3;
    this.refused = true;
    this.agreeing = true;
    this.root = element("div", { class: "compare" });
  }

  available() {
    const { observed, rendered, depth, matches } = this.shown;
    return MODES.filter((mode) =>
      mode === "Depth" ? depth : mode === "Matches" ? matches && observed : observed && rendered,
    );
  }

  show(shown) {
    this.shown = shown;
    clearInterval(this.timer);
    const modes = this.available();
    if (!modes.length) {
      this.root.replaceChildren(shown.observed ? this.still(shown.observed, "photo") : "");
      return;
    }
    this.mode = modes.includes(this.wanted) ? this.wanted : modes[0];
    this.draw();
  }

  choose(mode) {
    if (this.shown && this.available().includes(mode)) {
      this.mode = this.wanted = mode;
      this.draw();
    }
  }

  image(picture, label) {
    return element("img", { src: picture.url, alt: label, draggable: false });
  }

  still(picture, label) {
    const box = element("div", { class: "pictures" }, this.image(picture, label));
    box.style.aspectRatio = `${picture.width} / ${picture.height}`;
    return box;
  }

  draw() {
    clearInterval(this.timer);
    const base = this.shown.observed ?? this.shown.depth.picture;
    const box = element("div", { class: "pictures" }),
      under = element("div", { class: "under" });
    box.style.aspectRatio = `${base.width} / ${base.height}`;
    this[`draw${this.mode}`](box, under);
    const modes = element(
      "div",
      { class: "modes", role: "group", "aria-label": "Comparison" },
      ...this.available().map((mode) =>
        element("button", { "aria-pressed": String(mode === this.mode), onclick: () => this.choose(mode) }, mode),
      ),
    );
    const focused = this.root.querySelector(".modes :focus") !== null;
    this.root.replaceChildren(modes, box, under);
    if (focused) modes.querySelector("[aria-pressed=true]").focus();
  }

  tag(side, text) {
    return element("span", { class: `tag ${side}` }, text);
  }

  // Two pictures side by side at the edge; the label of each ends with it.
  drawWipe(box, under) {
    const label = this.shown.label ?? "rendered",
      edge = element("div", { class: "edge" });
    const left = element("div", {}, this.image(this.shown.observed, "photo"), this.tag("left", "photo"));
    const right = element("div", {}, this.image(this.shown.rendered, label), this.tag("right", label));
    const range = element("input", {
      type: "range",
      id: "wipe",
      min: "0",
      max: "100",
      "aria-label": "Share of the photo",
    });
    const move = (share) => {
      this.share = share;
      range.value = share;
      left.style.clipPath = `inset(0 ${100 - share}% 0 0)`;
      right.style.clipPath = `inset(0 0 0 ${share}%)`;
      edge.style.left = `${share}%`;
    };
    range.addEventListener("input", () => move(Number(range.value)));
    const drag = (event) => {
      const bounds = box.getBoundingClientRect();
      move(Math.max(0, Math.min(100, (100 * (event.clientX - bounds.left)) / bounds.width)));
    };
    box.addEventListener("pointerdown", (event) => {
      box.setPointerCapture(event.pointerId);
      drag(event);
    });
    box.addEventListener("pointermove", (event) => {
      if (event.buttons) drag(event);
    });
    box.append(right, left, edge);
    under.append(`only ${label}`, range, "only photo");
    move(this.share);
  }

  drawBlink(box, under) {
    const top = this.image(this.shown.observed, "photo"),
      label = element("span", { class: "tag left" });
    let on = true;
    const set = (value) => {
      on = value;
      top.style.visibility = on ? "visible" : "hidden";
      label.textContent = on ? "photo" : (this.shown.label ?? "rendered");
    };
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (!still) this.timer = setInterval(() => set(!on), 700);
    box.addEventListener("click", () => set(!on));
    box.append(this.image(this.shown.rendered, "rendered"), top, label);
    under.append(still ? "Click the picture to switch." : "What seems to move is not where the map shows it.");
    set(true);
  }

  drawDifference(box, under) {
    const { width, height } = this.shown.rendered,
      canvas = element("canvas", { width, height });
    const range = element("input", {
      type: "range",
      min: "1",
      max: "8",
      step: "0.5",
      value: String(this.gain),
      "aria-label": "Amplification",
    });
    const both = Promise.all([this.shown.observed, this.shown.rendered].map(({ url }) => pixels(url, width, height)));
    const paint = async () => {
      const [a, b] = await both,
        out = new ImageData(width, height);
      for (let i = 0; i < a.data.length; i++)
        out.data[i] = i % 4 === 3 ? 255 : this.gain * Math.abs(a.data[i] - b.data[i]);
      canvas.getContext("2d").putImageData(out, 0, 0);
    };
    range.addEventListener("input", () => {
      this.gain = Number(range.value);
      paint();
    });
    box.append(canvas);
    under.append("black where equal", range, "amplified");
    paint();
  }

  matchesText({ refused, by_appearance: looks, pose }) {
    const whose = pose ? `Matches of ${pose}. ` : "";
    const which = refused
      ? `Of those, ${looks} were matched by appearance alone, ${refused - looks} near where the pose predicts the landmark, but too far off. `
      : "";
    return `${whose}${which}Lines lead to where the landmark is.`;
  }

  async drawEdges(box, under) {
    const { width, height } = this.shown.rendered,
      canvas = element("canvas", { width, height });
    box.append(canvas);
    under.append(
      element("span", {}, element("i", { class: "dot", style: "background:#00be6e" }), "edges of the photo"),
      element("span", {}, element("i", { class: "dot", style: "background:#eb008c" }), "of the rendering"),
    );
    const [a, b] = await Promise.all(
      [this.shown.observed, this.shown.rendered].map(({ url }) => pixels(url, width, height)),
    );
    const ours = gradient(a),
      theirs = gradient(b),
      out = new ImageData(width, height);
    const green = [0, 190, 110],
      pink = [235, 0, 140];
    for (let i = 0; i < ours.length; i++) {
      for (let c = 0; c < 3; c++) {
        let value = (0.55 * (a.data[4 * i + c] + b.data[4 * i + c])) / 2 + 0.45 * 255;
        value += 0.9 * theirs[i] * (pink[c] - value);
        value += 0.9 * ours[i] * (green[c] - value);
        out.data[4 * i + c] = value;
      }
      out.data[4 * i + 3] = 255;
    }
    canvas.getContext("2d").putImageData(out, 0, 0);
  }

  drawDepth(box, under) {
    const { depth, observed, unit } = this.shown;
    if (observed) {
      const photo = this.image(observed, "photo");
      photo.style.filter = "grayscale(1) opacity(.35)";
      box.append(photo);
    }
    box.append(this.image(depth.picture, "depth difference"));
    const end = lengthText(depth.range, unit);
    under.append(`map nearer by ${end}`, element("div", { class: "scale" }), `farther by ${end}`);
    box.append(this.tag("left", `median difference ${lengthText(depth.median, unit)}`));
  }

  drawMatches(box, under) {
    const { observed, matches } = this.shown,
      photo = this.image(observed, "photo");
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("viewBox", `0 0 ${observed.width} ${observed.height}`);
    photo.style.filter = "brightness(.75)";
    const points = numbers(matches.keypoints),
      seen = numbers(matches.projections),
      accepted = numbers(matches.accepted);
    const add = (tag, attributes) => {
      const made = document.createElementNS(SVG, tag);
      for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
      svg.append(made);
    };
    const w = observed.width,
      h = observed.height;
    const draw = () => {
      svg.replaceChildren();
      for (let i = 0; i < accepted.length; i++) {
        const x = points[2 * i] * w,
          y = points[2 * i + 1] * h,
          u = seen[2 * i] * w,
          v = seen[2 * i + 1] * h;
        if (accepted[i] && this.agreeing)
          add("circle", { cx: x, cy: y, r: 2.6, fill: "none", stroke: "#4be08f", "stroke-width": 1.1 });
        if (accepted[i] || !this.refused) continue;
        if (Number.isFinite(u))
          add("line", { x1: x, y1: y, x2: u, y2: v, stroke: "#ff7a52", "stroke-width": 0.5, opacity: 0.6 });
        add("path", { d: `M${x - 2},${y - 2}l4,4m-4,0l4,-4`, stroke: "#ff7a52", "stroke-width": 1.2 });
      }
    };
    const box2 = (key, colour, text) =>
      element(
        "label",
        {},
        element("input", {
          type: "checkbox",
          checked: this[key],
          onchange: (event) => {
            this[key] = event.target.checked;
            draw();
          },
        }),
        element("i", { class: "dot", style: `background:${colour};margin:0` }),
        text,
      );
    under.append(
      box2("agreeing", "#2fb872", `${matches.agreeing} agree`),
      box2("refused", "#ff7a52", `${matches.refused} do not`),
      element("span", {}, this.matchesText(matches)),
    );
    box.append(photo, svg);
    draw();
  }
}
