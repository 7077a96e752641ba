// Charts of the last fifteen minutes: one sample each 0.75 s; what the selection adds comes last.

import { element } from "./format.js";

const SAMPLES = 1200;

export class Charts {
  constructor(root, ask) {
    this.root = root;
    this.ask = ask;
    this.charts = [];
  }

  // Show these series, each {key, title, text}, and ask for their history.
  show(series) {
    this.charts = series.map((each) => {
      const figure = element("b", {}, "");
      const canvas = element("canvas", { role: "img", "aria-label": `${each.title}, the last 15 minutes` });
      return { ...each, figure, canvas, samples: [], frame: element("div", { class: "chart" }, element("div", {}, element("span", {}, each.title), figure), canvas) };
    });
    this.root.replaceChildren(...this.charts.map((each) => each.frame));
    this.ask(this.charts.map((each) => each.key));
  }

  setHistory(key, samples) {
    for (const chart of this.charts) {
      if (chart.key !== key) continue;
      chart.samples = samples;
      this.draw(chart);
    }
  }

  // Take the newest values, and return what draws each chart.
  additions(values) {
    return this.charts.map((chart) => {
      chart.samples.push(values(chart.key) ?? 0);
      if (chart.samples.length > SAMPLES) chart.samples.shift();
      return () => this.draw(chart);
    });
  }

  redraw() {
    for (const chart of this.charts) this.draw(chart);
  }

  draw(chart) {
    const { canvas, samples } = chart;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    chart.figure.textContent = samples.length ? chart.text(samples.at(-1)) : "–";
    context.strokeStyle = style.getPropertyValue("--grid");
    context.lineWidth = 1;
    for (let minute = 0; minute <= 15; minute += 5) {
      const x = Math.round(((width - 1) * minute) / 15) + 0.5;
      context.beginPath();
      context.moveTo(x, 0);
      context.lineTo(x, height);
      context.stroke();
    }
    context.beginPath();
    context.moveTo(0, height - 0.5);
    context.lineTo(width, height - 0.5);
    context.stroke();
    if (!samples.length) return;
    const most = Math.max(...samples) * 1.1 || 1;
    const step = width / (SAMPLES - 1);
    const start = width - step * (samples.length - 1);
    context.beginPath();
    samples.forEach((each, at) => {
      const [x, y] = [start + at * step, height - 1.5 - (each / most) * (height - 4)];
      if (at) context.lineTo(x, y);
      else context.moveTo(x, y);
    });
    const colour = style.getPropertyValue(chart.isBad ? "--bad" : "--accent").trim();
    context.strokeStyle = colour;
    context.lineWidth = 1.5;
    context.stroke();
    context.lineTo(width, height);
    context.lineTo(start, height);
    context.globalAlpha = 0.12;
    context.fillStyle = colour;
    context.fill();
    context.globalAlpha = 1;
  }
}
