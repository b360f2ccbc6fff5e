// A trajectory: its path coloured by uncertainty or outcome, with a slider of time.
import { colourOf, element, find, lengthText, numbers, scaleColour, scaleGradient } from "./data.js";

const GREY = [0.55, 0.58, 0.62],
  GOOD = [0.13, 0.58, 0.35],
  BAD = [0.82, 0.31, 0.16];

export class Track {
  constructor(page, shown) {
    Object.assign(this, { page, shown, place: 0, rows: numbers(shown.poses) });
    this.count = this.rows.length / 12;
    const known = shown.sigmas.filter((sigma) => sigma !== null).sort((a, b) => a - b);
    this.low = known[0] ?? 0;
    this.high = Math.max(known[Math.floor(0.95 * (known.length - 1))] ?? 1, this.low + 1e-9);
    const ways = [...(known.length ? ["uncertainty"] : []), ...(shown.outcomes.some(Boolean) ? ["outcome"] : [])];
    this.way = ways[0] ?? "none";
    this.range = element("input", {
      type: "range",
      id: "time",
      min: "0",
      max: String(this.count - 1),
      step: "1",
      value: "0",
      "aria-label": "Pose of the trajectory",
      oninput: (event) => {
        this.stop();
        this.show(Number(event.target.value));
      },
    });
    this.button = element(
      "button",
      { id: "run", "aria-label": "Play the trajectory", onclick: () => this.play() },
      "▶",
    );
    this.text = element("p", { class: "small", id: "place" });
    const choice =
      ways.length > 1
        ? element(
            "select",
            {
              "aria-label": "Colour",
              onchange: (event) => {
                this.way = event.target.value;
                this.draw();
              },
            },
            ...ways.map((way) => element("option", { value: way }, `by ${way}`)),
          )
        : null;
    this.key = element("div", { class: "under" });
    find("trajectory").replaceChildren(
      element("h2", {}, `Trajectory ${shown.name}, ${this.count} poses`),
      element("div", { class: "row" }, this.button, this.range, ...(choice ? [choice] : [])),
      this.key,
      this.text,
    );
    this.range.style.flex = "1";
    this.draw();
    this.show(0);
  }

  colour(i) {
    const { sigmas, outcomes } = this.shown;
    if (this.way === "outcome") return outcomes[i] === "" ? GREY : outcomes[i] === "converged" ? GOOD : BAD;
    if (this.way === "uncertainty" && sigmas[i] !== null)
      return scaleColour((sigmas[i] - this.low) / (this.high - this.low));
    return GREY;
  }

  at(i) {
    return [3, 7, 11].map((k) => this.rows[12 * i + k]);
  }

  draw() {
    const places = [],
      colours = [];
    for (let i = 1; i < this.count; i++) {
      places.push(this.at(i - 1), this.at(i));
      colours.push(this.colour(i - 1), this.colour(i));
    }
    const { space } = this.page;
    space?.clear("track");
    if (places.length) space?.lines("track", places, null, { colours });
    const every = Array.from({ length: this.count }, (_, i) => i);
    space?.dots(
      "track",
      every.map((i) => this.at(i)),
      every.map((i) => this.colour(i)),
      0.06 * space.size,
    );
    this.marker = null;
    const bar = element("div", { class: "key" });
    bar.style.background = scaleGradient;
    const dot = ([r, g, b], text) => {
      const made = element("i", { class: "dot" });
      made.style.background = `rgb(${255 * r},${255 * g},${255 * b})`;
      return element("span", {}, made, text);
    };
    this.key.replaceChildren(
      ...(this.way === "uncertainty"
        ? [
            lengthText(this.low, this.page.map.unit),
            bar,
            `${lengthText(this.high, this.page.map.unit)} standard deviation`,
          ]
        : this.way === "outcome"
          ? [dot(GOOD, "accepted"), dot(BAD, "refused")]
          : []),
    );
    if (this.place) this.show(this.place);
  }

  show(i) {
    this.place = Math.max(0, Math.min(this.count - 1, i));
    this.range.value = String(this.place);
    const { frames, times, sigmas, outcomes } = this.shown,
      { space } = this.page;
    const time = times[this.place] === null ? null : `${(times[this.place] - (times[0] ?? 0)).toFixed(2)} s`;
    const sigma = sigmas[this.place] === null ? null : `± ${lengthText(sigmas[this.place], this.page.map.unit)}`;
    this.text.textContent = [
      `${this.place + 1} of ${this.count}`,
      time,
      frames[this.place],
      outcomes[this.place],
      sigma,
    ]
      .filter(Boolean)
      .join(" · ");
    space?.clear("runner");
    space?.frustum(
      "runner",
      [...this.rows.subarray(12 * this.place, 12 * this.place + 12), 0, 0, 0, 1],
      this.page.map.cameras[0]?.shape,
      colourOf("--accent"),
    );
  }

  play() {
    if (this.timer) {
      this.stop();
      return;
    }
    if (this.place >= this.count - 1) this.show(0);
    const from = this.place,
      began = performance.now(),
      seconds = Math.max(4, Math.min(30, this.count / 15));
    this.button.textContent = "❚❚";
    this.timer = setInterval(() => {
      this.show(Math.floor(from + ((performance.now() - began) / 1000 / seconds) * this.count));
      if (this.place >= this.count - 1) this.stop();
    }, 50);
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.button.textContent = "▶";
  }
}
