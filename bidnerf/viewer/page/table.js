// The rows of a file of results: filtered, sorted, each leading to its frame.
import { element, find, lengthText, percent } from "./data.js";

const MOST = 300; // rows that are drawn at a time

export class Results {
  constructor(page, rows) {
    Object.assign(this, {
      page,
      rows: rows.map((row, number) => ({ ...row, number })),
      text: "",
      kind: "all",
      order: "number",
      down: false,
      chosen: -1,
    });
    const outcomes = [...new Set(rows.map((row) => row.outcome))].sort();
    const kinds = [
      ["all", "all"],
      ["accepted", "accepted"],
      ["refused", "refused"],
      ...outcomes.map((name) => [`outcome ${name}`, name]),
    ];
    const search = element("input", {
      type: "search",
      id: "filter",
      placeholder: "Filter by frame, method, reason",
      "aria-label": "Filter",
      oninput: (event) => {
        this.text = event.target.value.toLowerCase();
        this.draw();
      },
    });
    const select = element(
      "select",
      {
        id: "kind",
        "aria-label": "Outcome",
        onchange: (event) => {
          this.kind = event.target.value;
          this.draw();
        },
      },
      ...kinds.map(([value, name]) => element("option", { value }, name)),
    );
    this.count = element("span", { class: "small" });
    this.body = element("tbody");
    const columns = [
      ["frame", "Frame"],
      ["outcome", "Outcome"],
      ["confidence", "Confidence"],
      ["position", "Error"],
    ];
    const head = element(
      "tr",
      {},
      ...columns.map(([key, name], i) =>
        element(
          "th",
          { scope: "col", class: i > 1 ? "number" : "" },
          element(
            "button",
            {
              onclick: () => {
                this.down = this.order === key && !this.down;
                this.order = key;
                this.draw();
              },
            },
            name,
          ),
        ),
      ),
    );
    find("results").replaceChildren(
      element("h2", {}, "Results"),
      element("div", { class: "row" }, search, select, this.count),
      element("div", { class: "scroller" }, element("table", { id: "rows" }, element("thead", {}, head), this.body)),
    );
    this.draw();
  }

  value(row) {
    return this.order === "position" ? (row.error?.[0] ?? Infinity) : (row[this.order] ?? -Infinity);
  }

  matching() {
    const fits = (row) =>
      (this.kind === "all" ||
        (this.kind === "accepted" && row.accepted) ||
        (this.kind === "refused" && !row.accepted) ||
        this.kind === `outcome ${row.outcome}`) &&
      `${row.frame} ${row.method} ${row.outcome} ${row.reason}`.toLowerCase().includes(this.text);
    const sign = this.down ? -1 : 1;
    return this.rows.filter(fits).sort((a, b) => {
      const x = this.value(a),
        y = this.value(b);
      return sign * (x < y ? -1 : x > y ? 1 : a.number - b.number);
    });
  }

  draw() {
    const found = this.matching();
    this.count.textContent = `${found.length} of ${this.rows.length}`;
    this.body.replaceChildren(
      ...found.slice(0, MOST).map((row) => {
        const error = row.error ? `${lengthText(row.error[0], this.page.map.unit)}, ${row.error[1].toFixed(2)}°` : "–";
        const line = element(
          "tr",
          {
            tabindex: "0",
            "aria-selected": String(row.number === this.chosen),
            title: row.reason,
            onclick: () => this.choose(row),
            onkeydown: (event) => {
              if (event.key === "Enter") this.choose(row);
            },
          },
          element("td", {}, row.frame, element("small", {}, row.method)),
          element("td", {}, row.accepted ? "accepted" : row.outcome),
          element("td", { class: "number" }, row.confidence === null ? "–" : percent(row.confidence)),
          element("td", { class: "number" }, error),
        );
        if (!row.accepted) line.classList.add("failed");
        return line;
      }),
    );
  }

  choose(row) {
    this.chosen = row.number;
    this.draw();
    this.page.goToRow(row);
  }

  chooseFrame(name) {
    const row = this.rows.find((each) => each.frame === name);
    if (row) this.choose(row);
    return row !== undefined;
  }
}
