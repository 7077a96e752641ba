// Canvas of the network: domains as soft areas, switches, satellites, links by traffic; path and tree of a name on top.

import { bits, millis } from "./format.js";
import { place } from "./layout.js";

const HUES = [214, 152, 28, 280, 340, 188, 52, 98, 255, 8];
const STEP = 1.25;

export class GraphView {
  constructor(canvas, store, onSelect) {
    this.canvas = canvas;
    this.store = store;
    this.onSelect = onSelect;
    this.context = canvas.getContext("2d", { alpha: false });
    this.points = [];
    this.places = new Map(); // by id, kept when the structure changes
    this.view = { x: 0, y: 0, scale: 1 };
    this.focus = -1; // node under the keyboard
    this.hover = -1;
    this.isFitted = true;
    this.isDirty = false;
    this.edges = new Set();
    this.colours = {};
    this.readColours();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.listen();
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    for (const key of ["page", "card", "line", "text", "soft", "faint", "accent", "path", "bad", "grid"]) {
      this.colours[key] = style.getPropertyValue(`--${key}`).trim();
    }
    this.isDark = document.documentElement.dataset.theme === "dark";
    this.redraw();
  }

  hue(domain) {
    const at = this.store.domains.findIndex((each) => each.id === domain);
    return HUES[(at < 0 ? 0 : at) % HUES.length];
  }

  fill(domain) {
    return this.isDark ? `hsl(${this.hue(domain)} 55% 62%)` : `hsl(${this.hue(domain)} 60% 42%)`;
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth) return;
    this.canvas.width = Math.round(clientWidth * ratio);
    this.canvas.height = Math.round(clientHeight * ratio);
    this.ratio = ratio;
    if (this.isFitted) this.fit();
    this.redraw();
  }

  structureChanged() {
    const from = this.places;
    this.points = place(this.store, from);
    this.places = new Map(this.store.nodes.map((each, at) => [each.id, this.points[at]]));
    this.pairs = new Map(this.store.links.map((each) => [`${each.a} ${each.b}`, each]));
    this.adjacent = new Map();
    for (const each of this.store.links) {
      this.adjacent.set(each.a, [...(this.adjacent.get(each.a) ?? []), each.b]);
      this.adjacent.set(each.b, [...(this.adjacent.get(each.b) ?? []), each.a]);
    }
    this.focus = Math.min(this.focus, this.points.length - 1);
    this.hover = -1;
    this.hulls = this.store.domains.map((domain) => ({ domain, path: hullOf(this.store, this.points, domain.id) }));
    if (this.isFitted) this.fit();
    this.selectionChanged();
  }

  selectionChanged() {
    this.edges = this.store.treeEdges();
    this.lit = null;
    const selected = this.store.selected;
    if (selected?.kind === "name") {
      const name = this.store.name(selected.id);
      this.lit = name ? this.store.nameEnds(name) : new Set();
      for (const edge of this.edges) for (const at of edge.split(" ")) this.lit.add(Number(at));
    } else if (selected?.kind === "node") {
      const at = this.store.nodeAt.get(selected.id);
      if (at !== undefined) this.lit = new Set([at, ...(this.adjacent?.get(at) ?? [])]);
    }
    this.redraw();
  }

  fit() {
    const here = this.points.filter(Boolean);
    if (!here.length || !this.canvas.clientWidth) return;
    const xs = here.map((each) => each.x);
    const ys = here.map((each) => each.y);
    const [left, right, top, bottom] = [Math.min(...xs) - 70, Math.max(...xs) + 70, Math.min(...ys) - 62, Math.max(...ys) + 66];
    const scale = Math.min(this.canvas.clientWidth / (right - left), (this.canvas.clientHeight - 56) / (bottom - top), 2);
    this.view = { scale, x: this.canvas.clientWidth / 2 - (scale * (left + right)) / 2, y: (this.canvas.clientHeight - 8) / 2 - (scale * (top + bottom)) / 2 };
    this.isFitted = true;
    this.redraw();
  }

  zoom(factor, x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2) {
    const scale = Math.min(Math.max(this.view.scale * factor, 0.05), 6);
    const real = scale / this.view.scale;
    this.view = { scale, x: x - (x - this.view.x) * real, y: y - (y - this.view.y) * real };
    this.isFitted = false;
    this.redraw();
  }

  redraw() {
    if (this.isDirty) return;
    this.isDirty = true;
    requestAnimationFrame(() => {
      this.isDirty = false;
      this.draw();
    });
  }

  draw() {
    const { context, view, store, colours } = this;
    const ratio = this.ratio ?? 1;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = colours.page;
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    if (!this.points.length) return;
    context.setTransform(ratio * view.scale, 0, 0, ratio * view.scale, ratio * view.x, ratio * view.y);
    this.grow = Math.min(Math.max(0.62 / view.scale, 1), 1.9); // small scales keep nodes visible
    for (const { domain, path } of this.hulls ?? []) this.drawHull(domain, path);
    for (const link of store.links) this.drawLink(link);
    if (this.edges.size) this.drawTree();
    context.lineWidth = 1.5;
    this.points.forEach((point, at) => point && this.drawNode(point, at));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.drawLabels();
    if (!this.isDrawn) {
      this.isDrawn = true;
      performance.mark("first-picture");
    }
  }

  drawHull(domain, path) {
    if (!path) return;
    const { context } = this;
    const hue = this.hue(domain.id);
    context.fillStyle = this.isDark ? `hsl(${hue} 45% 50% / 11%)` : `hsl(${hue} 60% 50% / 9%)`;
    context.strokeStyle = this.isDark ? `hsl(${hue} 45% 55% / 30%)` : `hsl(${hue} 50% 45% / 26%)`;
    context.lineWidth = 1 / this.view.scale;
    context.fill(path);
    context.stroke(path);
  }

  drawLink(link) {
    const [from, to] = [this.points[link.a], this.points[link.b]];
    if (!from || !to) return;
    const { context, colours } = this;
    const rate = link.ab + link.ba;
    const isDim = this.lit && !(this.lit.has(link.a) && this.lit.has(link.b));
    const isChosen = this.store.selected?.kind === "link" && this.store.selected.id === link.id;
    context.globalAlpha = isDim ? 0.25 : 1;
    context.strokeStyle = isChosen ? colours.accent : link.loss >= 0.01 ? colours.bad : rate > 1e4 ? colours.accent : colours.faint;
    context.lineWidth = (isChosen ? 3 : this.grow) + Math.min(Math.max(Math.log10(rate + 1) - 3.2, 0), 4) * 1.1;
    context.beginPath();
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
    context.stroke();
    context.globalAlpha = 1;
  }

  drawTree() {
    const { context, colours } = this;
    context.strokeStyle = context.fillStyle = colours.path;
    for (const edge of this.edges) {
      const [from, to] = edge.split(" ").map((at) => this.points[at]);
      if (!from || !to) continue;
      const angle = Math.atan2(to.y - from.y, to.x - from.x);
      context.lineWidth = 5 * this.grow;
      context.beginPath();
      context.moveTo(from.x, from.y);
      context.lineTo(to.x, to.y);
      context.stroke();
      const [x, y] = [from.x + (to.x - from.x) * 0.66, from.y + (to.y - from.y) * 0.66];
      const long = 12 * this.grow;
      context.beginPath();
      context.moveTo(x + long * Math.cos(angle), y + long * Math.sin(angle));
      context.lineTo(x + long * Math.cos(angle + 2.4), y + long * Math.sin(angle + 2.4));
      context.lineTo(x + long * Math.cos(angle - 2.4), y + long * Math.sin(angle - 2.4));
      context.fill();
    }
  }

  drawNode(point, at) {
    const { context, colours, store } = this;
    const node = store.nodes[at];
    const isChosen = store.selected?.kind === "node" && store.selected.id === node.id;
    const size = (node.isSwitch ? 13 : 8) * this.grow;
    context.globalAlpha = this.lit && !this.lit.has(at) ? 0.3 : 1;
    const colour = this.fill(node.domain);
    context.fillStyle = node.near ? (node.isSwitch ? colour : colours.card) : colours.page;
    context.strokeStyle = store.waiting[node.id] ? colours.bad : colour;
    context.lineWidth = store.waiting[node.id] ? 3 : 2;
    context.beginPath();
    if (node.role === "rib") {
      context.moveTo(point.x, point.y - size - 1);
      context.lineTo(point.x + size + 1, point.y);
      context.lineTo(point.x, point.y + size + 1);
      context.lineTo(point.x - size - 1, point.y);
      context.closePath();
    } else if (node.isSwitch) context.roundRect(point.x - size, point.y - size, 2 * size, 2 * size, node.role === "leaf" ? size : 6);
    else context.arc(point.x, point.y, size, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
    if (node.isSwitch && node.near && this.view.scale > 0.5) {
      context.strokeStyle = colours.card;
      context.lineWidth = 2;
      context.beginPath();
      context.moveTo(point.x - 6, point.y - 3);
      context.lineTo(point.x + 6, point.y - 3);
      context.moveTo(point.x + 2, point.y - 6.5);
      context.lineTo(point.x + 6, point.y - 3);
      context.moveTo(point.x + 6, point.y + 3.5);
      context.lineTo(point.x - 6, point.y + 3.5);
      context.lineTo(point.x - 2, point.y + 7);
      context.stroke();
    }
    const isEnd = this.lit && store.selected?.kind === "name" && this.lit.has(at) && !node.isSwitch;
    if (isChosen || at === this.focus || at === this.hover || isEnd) {
      context.strokeStyle = isEnd && at !== this.focus ? colours.path : colours.accent;
      context.lineWidth = at === this.focus ? 3 : 2;
      context.beginPath();
      context.arc(point.x, point.y, size + 7, 0, 2 * Math.PI);
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  drawLabels() {
    const { context, colours, view, store } = this;
    const screen = (point) => [view.x + view.scale * point.x, view.y + view.scale * point.y];
    const isSmall = store.nodes.length <= 60;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.font = "12px system-ui, 'DejaVu Sans', sans-serif";
    context.lineJoin = "round";
    const write = (text, x, y, colour) => {
      context.strokeStyle = colours.page;
      context.lineWidth = 3.5;
      context.strokeText(text, x, y);
      context.fillStyle = colour;
      context.fillText(text, x, y);
    };
    if (store.links.length <= 40 && view.scale > 0.65) {
      for (const link of store.links) {
        if (!store.nodes[link.a].isSwitch || !store.nodes[link.b].isSwitch) continue;
        const [x, y] = screen({ x: (this.points[link.a].x + this.points[link.b].x) / 2, y: (this.points[link.a].y + this.points[link.b].y) / 2 });
        const isDim = this.lit && !(this.lit.has(link.a) && this.lit.has(link.b));
        context.globalAlpha = isDim ? 0.35 : 1;
        write(bits(link.ab + link.ba), x, y - 8, colours.text);
        write(millis(link.rtt), x, y + 7, link.loss >= 0.01 ? colours.bad : colours.soft);
        context.globalAlpha = 1;
      }
    }
    this.points.forEach((point, at) => {
      if (!point) return;
      const node = store.nodes[at];
      const isMarked = at === this.focus || at === this.hover || (this.lit?.has(at) && this.lit.size <= 40) || store.selected?.id === node.id;
      const isShown = isMarked || (node.isSwitch ? isSmall || view.scale > 0.75 : (isSmall && view.scale > 0.55) || view.scale > 1.3);
      if (!isShown) return;
      const [x, y] = screen(point);
      if (x < -60 || y < -20 || x > this.canvas.clientWidth + 60 || y > this.canvas.clientHeight + 20) return;
      context.globalAlpha = this.lit && !this.lit.has(at) ? 0.35 : 1;
      write(node.label, x, y + (node.isSwitch ? 13 : 8) * view.scale * this.grow + 11, node.near ? colours.text : colours.soft);
      context.globalAlpha = 1;
    });
    context.font = "600 12px system-ui, 'DejaVu Sans', sans-serif";
    for (const { domain, path } of this.hulls ?? []) {
      if (!path) continue;
      const [x, y] = screen(path.top);
      write(domain.label, x, y - 10, this.fill(domain.id));
    }
  }

  at(x, y) {
    const reach = Math.max(12 / this.view.scale, 14);
    const [px, py] = [(x - this.view.x) / this.view.scale, (y - this.view.y) / this.view.scale];
    let best = -1;
    let near = reach;
    this.points.forEach((point, at) => {
      if (!point) return;
      const distance = Math.hypot(point.x - px, point.y - py);
      if (distance < near) [near, best] = [distance, at];
    });
    return best;
  }

  linkAt(x, y) {
    const [px, py] = [(x - this.view.x) / this.view.scale, (y - this.view.y) / this.view.scale];
    const reach = 7 / this.view.scale;
    return this.store.links.find((link) => {
      const [a, b] = [this.points[link.a], this.points[link.b]];
      if (!a || !b) return false;
      const along = ((px - a.x) * (b.x - a.x) + (py - a.y) * (b.y - a.y)) / ((b.x - a.x) ** 2 + (b.y - a.y) ** 2 || 1);
      return along > 0 && along < 1 && Math.hypot(a.x + along * (b.x - a.x) - px, a.y + along * (b.y - a.y) - py) < reach;
    });
  }

  listen() {
    const { canvas } = this;
    let drag = null;
    canvas.addEventListener("pointerdown", (event) => {
      drag = { x: event.offsetX, y: event.offsetY, hasMoved: false };
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!drag) {
        const at = this.at(event.offsetX, event.offsetY);
        if (at !== this.hover) {
          this.hover = at;
          canvas.style.cursor = at >= 0 ? "pointer" : "";
          this.redraw();
        }
        return;
      }
      const [dx, dy] = [event.offsetX - drag.x, event.offsetY - drag.y];
      if (!drag.hasMoved && Math.hypot(dx, dy) < 4) return;
      Object.assign(drag, { x: event.offsetX, y: event.offsetY, hasMoved: true });
      canvas.classList.add("drag");
      this.view.x += dx;
      this.view.y += dy;
      this.isFitted = false;
      this.redraw();
    });
    const end = (event) => {
      canvas.classList.remove("drag");
      if (drag && !drag.hasMoved) {
        const at = this.at(event.offsetX, event.offsetY);
        const link = at < 0 ? this.linkAt(event.offsetX, event.offsetY) : null;
        if (at >= 0) this.onSelect({ kind: "node", id: this.store.nodes[at].id });
        else this.onSelect(link ? { kind: "link", id: link.id } : null);
      }
      drag = null;
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", () => (drag = null));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(event.deltaY < 0 ? 1.12 : 1 / 1.12, event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("blur", () => {
      this.focus = -1;
      this.redraw();
    });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    const ways = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowDown: [0, 1], ArrowUp: [0, -1] };
    if (ways[event.key]) this.moveFocus(...ways[event.key]);
    else if (event.key === "Enter" || event.key === " ") {
      if (this.focus >= 0) this.onSelect({ kind: "node", id: this.store.nodes[this.focus].id });
    } else return;
    event.preventDefault();
  }

  moveFocus(dx, dy) {
    if (!this.points.length) return;
    if (this.focus < 0) {
      const chosen = this.store.selected?.kind === "node" ? this.store.nodeAt.get(this.store.selected.id) : undefined;
      this.focus = chosen ?? 0;
    } else {
      const here = this.points[this.focus];
      let best = Infinity;
      let next = this.focus;
      this.points.forEach((point, at) => {
        if (!point || at === this.focus) return;
        const along = (point.x - here.x) * dx + (point.y - here.y) * dy;
        const across = Math.abs((point.x - here.x) * dy) + Math.abs((point.y - here.y) * dx);
        const cost = along + 2.2 * across;
        if (along > 4 && cost < best) [best, next] = [cost, at];
      });
      this.focus = next;
    }
    this.reveal(this.points[this.focus]);
    const node = this.store.nodes[this.focus];
    this.canvas.setAttribute("aria-label", `${node.role} ${node.label}. Enter selects it.`);
    this.redraw();
  }

  reveal(point) {
    const [x, y] = [this.view.x + this.view.scale * point.x, this.view.y + this.view.scale * point.y];
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    if (x < 40 || x > width - 40) this.view.x += width / 2 - x;
    if (y < 40 || y > height - 40) this.view.y += height / 2 - y;
  }

  get step() {
    return STEP;
  }
}

// A soft area around the switches of a domain, with ``top``, where its label goes.
function hullOf(store, points, domain) {
  const inside = [];
  store.nodes.forEach((node, at) => {
    if (node.domain !== domain || !points[at]) return;
    const radius = node.isSwitch ? 34 : 24;
    for (let part = 0; part < 10; part += 1) {
      const angle = (part * Math.PI) / 5;
      inside.push([points[at].x + radius * Math.cos(angle), points[at].y + radius * Math.sin(angle)]);
    }
  });
  if (!inside.length) return null;
  inside.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const turn = (o, a, b) => (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]);
  const half = (list) => {
    const chain = [];
    for (const point of list) {
      while (chain.length > 1 && turn(chain.at(-2), chain.at(-1), point) <= 0) chain.pop();
      chain.push(point);
    }
    chain.pop();
    return chain;
  };
  const outline = [...half(inside), ...half(inside.slice().reverse())];
  const path = new Path2D();
  outline.forEach(([x, y], at) => (at ? path.lineTo(x, y) : path.moveTo(x, y)));
  path.closePath();
  const top = outline.reduce((best, each) => (each[1] < best[1] ? each : best));
  path.top = { x: top[0], y: top[1] };
  return path;
}
