// What is said about an answer: outcome, uncertainty, figures, contests of explanations.
import { element, lengthText, percent, withCode } from "./data.js";

// Outcomes whose name says less than what they mean.
const PLAINLY = {
  "too few matches": "probably another scene",
  undetermined: "the photo shows too little",
  "bad input": "this file cannot be used",
};

export function outcomeOf(answer) {
  const facts = [];
  if (answer.accepted && answer.confidence !== null) facts.push(`${percent(answer.confidence)} likely to be right`);
  if (answer.seconds) facts.push(`${Number(answer.seconds.toPrecision(3))}\u00a0s`);
  if (answer.method) facts.push(`method\u00a0${answer.method}`);
  const lines = [
    element("p", { class: "name" }, answer.name),
    element(
      "p",
      { class: `outcome ${answer.accepted ? "good" : "bad"}` },
      element("b", {}, answer.accepted ? "Accepted" : `Refused: ${PLAINLY[answer.outcome] ?? answer.outcome}`),
      element("span", { title: answer.method_summary }, facts.join(" · ")),
    ),
    element("p", { class: "reason" }, answer.reason),
  ];
  if (answer.advice) {
    lines.push(
      element(
        "p",
        { class: "advice" },
        ...withCode(answer.meaning),
        element("br"),
        element("b", {}, "What to try: "),
        ...withCode(answer.advice),
      ),
    );
  }
  if (answer.error) {
    lines.push(
      element(
        "p",
        { class: "reason" },
        `True error: ${lengthText(answer.error[0], answer.unit)} and ${answer.error[1].toFixed(2)}°`,
      ),
    );
  }
  return lines;
}

export function uncertainty(answer, factor) {
  if (!answer.pose) return [];
  if (!answer.ellipsoid)
    return [element("h2", {}, "Uncertainty"), element("p", { class: "empty" }, "The answer has no covariance.")];
  const { lengths, rotation_deg: turns } = answer.ellipsoid;
  const enlarged = factor > 1 ? ` It is drawn ${factor} times as large.` : "";
  return [
    element("h2", {}, "Uncertainty (two standard deviations)"),
    element(
      "p",
      {},
      `Position ± ${lengths.map((x) => lengthText(x, answer.unit)).join(", ")} along the axes of the ellipsoid; ` +
        `orientation ± ${turns.map((x) => `${(2 * x).toFixed(2)}°`).join(", ")} about the camera's axes.${enlarged}`,
    ),
  ];
}

// A bar from zero to the value, with a tick at the threshold in its middle; the side where values fail is tinted.
function gauge({ value, at_least: least }) {
  const fill = element("i"),
    bar = element("div", { class: `gauge ${least ? "least" : "most"}` }, fill, element("b"));
  fill.style.width = `${100 * value}%`;
  return bar;
}

function table(figures) {
  const rows = figures.map((figure) => {
    const mark = figure.passed === null ? "" : figure.passed ? "✓" : "✗";
    return element(
      "tr",
      { class: figure.passed === false ? "failed" : "" },
      element(
        "td",
        { class: "mark", "aria-label": figure.passed === false ? "failed" : figure.passed ? "passed" : "" },
        mark,
      ),
      element(
        "th",
        { scope: "row" },
        figure.name,
        element("small", {}, figure.meaning),
        figure.bar ? gauge(figure.bar) : null,
      ),
      element("td", { class: "number" }, figure.value, element("small", {}, figure.threshold)),
    );
  });
  return element("table", {}, element("tbody", {}, ...rows));
}

// Figures of each pose that was measured; those that did not fail are folded away behind those that did.
export function figures(answer) {
  const parts = [...new Set(answer.figures.map(({ pose }) => pose))].flatMap((pose) => {
    const all = answer.figures.filter((figure) => figure.pose === pose),
      failed = all.filter(({ passed }) => passed === false);
    const others = all.filter((figure) => !failed.includes(figure));
    const folded =
      failed.length && others.length
        ? element(
            "details",
            { class: "folded" },
            element("summary", {}, `${others.length} more, which did not fail`),
            table(others),
          )
        : null;
    return [
      element("h2", {}, pose ? `Figures of ${pose}` : "Figures"),
      table(folded ? failed : all),
      ...(folded ? [folded] : []),
    ];
  });
  return parts.length
    ? [
        element(
          "div",
          { id: "figures" },
          ...parts,
          element(
            "p",
            { class: "small" },
            "The mark on a bar is the threshold, its end twice that or more; values in the tinted part fail.",
          ),
        ),
      ]
    : [];
}

export function contests(answer, ofPose) {
  return answer.contests
    .filter((each) => each.of_pose === ofPose)
    .flatMap(({ question, answers, note }) => {
      const most = Math.max(...answers.map((each) => each.probability));
      const lines = answers.flatMap(({ name, probability }) => {
        const fill = element("i");
        fill.style.width = `${100 * probability}%`;
        return [
          element(
            "p",
            { class: probability === most ? "likeliest" : "" },
            element("span", {}, name),
            element("span", {}, percent(probability)),
          ),
          element("div", { class: "gauge plain" }, fill),
        ];
      });
      return [
        element("h2", {}, question),
        note && !answer.reason.includes(note) ? element("p", { class: "small" }, note) : null,
        element("div", { class: "weighed" }, ...lines),
      ];
    });
}

export function poseText(answer, pose) {
  if (!pose) return [];
  const rows = [0, 4, 8, 12]
    .map((i) =>
      pose
        .slice(i, i + 4)
        .map((x) => x.toFixed(4).padStart(9))
        .join(" "),
    )
    .join("\n");
  return [
    element("h2", {}, "Pose, camera to world (OpenCV axes)"),
    element("pre", {}, rows),
    answer.camera ? element("p", { class: "small" }, `Camera of this pose: ${answer.camera}`) : null,
    answer.method_summary
      ? element("p", { class: "small" }, `Method ${answer.method}: ${answer.method_summary}`)
      : null,
  ];
}
