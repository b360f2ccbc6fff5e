// What is said about an answer: outcome, uncertainty, figures, explanations.
import { element, lengthText, percent } from "./data.js";

export function outcomeOf(answer) {
  const facts = [];
  if (answer.accepted && answer.confidence !== null) facts.push(`${percent(answer.confidence)} likely to be right`);
  if (answer.seconds) facts.push(`${answer.seconds.toFixed(2)} s`);
  if (answer.method) facts.push(`method ${answer.method}`);
  const lines = [
    element("p", { class: "name" }, answer.name),
    element("p", { class: `outcome ${answer.accepted ? "good" : "bad"}` },
      element("b", {}, answer.accepted ? "Accepted" : `Refused: ${answer.outcome}`), element("span", {}, facts.join(" · "))),
    element("p", { class: "reason" }, answer.reason),
  ];
  if (answer.error) {
    lines.push(element("p", { class: "reason" }, `True error: ${lengthText(answer.error[0], answer.unit)} and ${answer.error[1].toFixed(2)}°`));
  }
  return lines;
}

export function uncertainty(answer, factor) {
  if (!answer.ellipsoid) return [element("h2", {}, "Uncertainty"), element("p", { class: "empty" }, "No covariance is known for this pose.")];
  const { lengths, rotation_deg: turns } = answer.ellipsoid;
  const enlarged = factor > 1 ? ` It is drawn ${factor} times as large.` : "";
  return [
    element("h2", {}, "Uncertainty (two standard deviations)"),
    element("p", {}, `Position ± ${lengths.map((x) => lengthText(x, answer.unit)).join(", ")} along the axes of the ellipsoid; `
      + `orientation ± ${turns.map((x) => `${(2 * x).toFixed(2)}°`).join(", ")} about the camera's axes.${enlarged}`),
  ];
}

export function figures(answer) {
  if (!answer.figures.length) return [];
  const rows = answer.figures.map((figure) => {
    const bar = element("div", { class: figure.fulfilled === null ? "" : "gauge threshold" });
    if (figure.fulfilled !== null) {
      const fill = element("i");
      fill.style.width = `${50 * figure.fulfilled}%`;
      bar.append(fill);
    }
    const mark = figure.passed === null ? "" : figure.passed ? "✓" : "✗";
    return element("tr", { class: figure.passed === false ? "failed" : "" },
      element("td", { class: "mark", "aria-label": figure.passed === false ? "failed" : figure.passed ? "passed" : "" }, mark),
      element("th", { scope: "row" }, figure.name, element("small", {}, figure.meaning), bar),
      element("td", { class: "number" }, figure.value, element("small", {}, figure.threshold)));
  });
  return [element("h2", {}, "Figures and thresholds"), element("table", { id: "figures" }, element("tbody", {}, ...rows))];
}

export function explanations(answer) {
  if (!answer.explanations.length) return [];
  const questions = [...new Set(answer.explanations.map((each) => each.question))];
  const titles = { "whose camera": "Whose camera took it?", "which pose": "Which pose is right?" };
  return questions.flatMap((question) => {
    const lines = answer.explanations.filter((each) => each.question === question).flatMap((each) => {
      const fill = element("i");
      fill.style.width = `${100 * each.probability}%`;
      return [
        element("p", { class: each.chosen ? "chosen" : "" }, element("span", {}, each.name), element("span", {}, percent(each.probability))),
        element("div", { class: "gauge plain" }, fill),
      ];
    });
    return [element("h2", {}, titles[question] ?? question), element("div", { class: "weighed" }, ...lines)];
  });
}

export function poseText(answer) {
  if (!answer.pose) return [];
  const rows = [0, 4, 8, 12].map((i) => answer.pose.slice(i, i + 4).map((x) => x.toFixed(4).padStart(9)).join(" ")).join("\n");
  return [element("h2", {}, "Pose, camera to world (OpenCV axes)"), element("pre", {}, rows),
    answer.camera ? element("p", { class: "small" }, `Camera: ${answer.camera}`) : null];
}
