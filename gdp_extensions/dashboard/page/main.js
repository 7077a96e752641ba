// Live view: connects, keeps what came, and redraws what it concerns.

import { Charts } from "./charts.js";
import { bits, element, millis, perSecond } from "./format.js";
import { GraphView } from "./graph.js";
import { NameList } from "./names.js";
import { Panels } from "./panels.js";
import { Store } from "./store.js";

const AGAIN_MS = [500, 1000, 2000, 4000];
const byId = (id) => document.getElementById(id);

const store = new Store();
let socket = null;
let tries = 0;

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function select(what) {
  store.selected = what;
  store.trees = { id: "", rows: [] };
  send({ name: what?.kind === "name" ? what.id : "" });
  graph.selectionChanged();
  names.draw();
  panels.drawSelection();
  showCharts();
  hint();
}

const graph = new GraphView(byId("graph"), store, select);
const names = new NameList(store, select);
const panels = new Panels(store, select);
const charts = new Charts(byId("charts"), (keys) => send({ history: keys }));

function hint() {
  const { selected } = store;
  const name = selected?.kind === "name" ? store.name(selected.id) : null;
  byId("hint").textContent = name ? `Path and tree of ${name.label}` : "";
}

function showCharts() {
  const { selected } = store;
  const series = [
    { key: "total bytes", title: "Traffic on all links", text: bits },
    { key: "total messages", title: "Messages published", text: perSecond },
    { key: "total drops", title: "Drops", text: perSecond, isBad: true },
    { key: "total rtt", title: "Slowest link, round trip", text: millis },
  ];
  if (selected?.kind === "name") series.push({ key: `name ${selected.id}`, title: store.name(selected.id)?.label ?? "name", text: perSecond });
  if (selected?.kind === "node") series.push({ key: `drop ${selected.id}`, title: `Drops at ${store.nodeText(selected.id)}`, text: perSecond, isBad: true });
  if (selected?.kind === "link") {
    series.push({ key: `link ${selected.id}`, title: "This link", text: bits }, { key: `rtt ${selected.id}`, title: "Its round trip", text: millis });
  }
  charts.show(series);
}

function newest(key) {
  const [kind, id, other] = key.split(" ");
  if (kind === "total") return { bytes: store.totals.bytes_s, messages: store.totals.messages_s, drops: store.totals.drops_s, rtt: store.totals.rtt_ms }[id];
  if (kind === "name") return store.name(id)?.rate;
  if (kind === "drop") return store.drops.filter(([node]) => node === id).reduce((sum, each) => sum + each[3], 0);
  const link = store.links.find((each) => each.id === `${id} ${other}`);
  return link && (kind === "link" ? link.ab + link.ba : link.rtt);
}

function legend() {
  const shape = (inner) => {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 12 12");
    const part = document.createElementNS(svg.namespaceURI, inner[0]);
    for (const [key, value] of Object.entries(inner[1])) part.setAttribute(key, value);
    svg.append(part);
    return svg;
  };
  const line = { fill: "none", stroke: "currentColor", "stroke-width": 1.6 };
  byId("legend").replaceChildren(
    element("span", {}, shape(["rect", { x: 0, y: 0, width: 12, height: 12, rx: 3, fill: "currentColor" }]), "switch"),
    element("span", {}, shape(["circle", { cx: 6, cy: 6, r: 5, ...line }]), "proxy"),
    element("span", {}, shape(["path", { d: "M6 0 12 6 6 12 0 6Z", ...line }]), "RIB"),
    element("span", {}, shape(["path", { d: "M0 6H12", ...line, "stroke-width": 3 }]), "link, wider with traffic; rate and round trip"),
  );
}

const waiting = [];

function inTurn(...parts) {
  const isIdle = !waiting.length;
  waiting.push(...parts);
  const next = () => {
    waiting.shift()();
    if (waiting.length) requestAnimationFrame(next);
  };
  if (isIdle) requestAnimationFrame(next);
}

const handlers = {
  structure(message) {
    store.setStructure(message);
    graph.structureChanged();
    names.apply();
    panels.drawClusters();
    hint();
  },
  figures(message) {
    const hasEvents = store.setFigures(message) || !store.isShown;
    store.isShown = true;
    if (hasEvents) panels.drawEvents();
    graph.redraw();
    // One part a frame, so that no frame is late for the others.
    inTurn(
      () => panels.drawTotals(),
      () => panels.drawDetail(),
      () => panels.drawReplicas(),
      () => panels.drawDrops(),
      () => (names.filter === "active" ? names.apply() : names.draw()),
      ...charts.additions(newest),
      () => (document.body.dataset.updated = String(message.unix_s)),
    );
  },
  name(message) {
    store.trees = { id: message.id, rows: message.trees };
    graph.selectionChanged();
    panels.drawDetail();
  },
  history(message) {
    charts.setHistory(message.key, message.samples);
  },
};

function say(state, text) {
  byId("state").dataset.state = state;
  byId("state").textContent = text;
}

function connect() {
  socket = new WebSocket(new URL("live", document.baseURI).href.replace(/^http/, "ws"));
  socket.addEventListener("open", () => {
    tries = 0;
    say("live", "live");
    store.events = [];
    showCharts();
    if (store.selected?.kind === "name") send({ name: store.selected.id });
  });
  socket.addEventListener("message", (event) => {
    const message = JSON.parse(event.data);
    handlers[message.kind]?.(message);
  });
  socket.addEventListener("close", (event) => {
    say("lost", event.reason || "the server does not answer; trying again");
    setTimeout(connect, AGAIN_MS[Math.min(tries, AGAIN_MS.length - 1)]);
    tries += 1;
  });
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  byId("theme").textContent = theme === "dark" ? "Light" : "Dark";
  graph.readColours();
  charts.redraw();
}

const prefersDark = matchMedia("(prefers-color-scheme: dark)");
setTheme(localStorage.getItem("theme") ?? (prefersDark.matches ? "dark" : "light"));
prefersDark.addEventListener("change", (event) => localStorage.getItem("theme") ?? setTheme(event.matches ? "dark" : "light"));

function switchTheme() {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("theme", theme);
  setTheme(theme);
}

byId("theme").addEventListener("click", switchTheme);
byId("keys").addEventListener("click", () => byId("help").showModal());
byId("zoom-in").addEventListener("click", () => graph.zoom(graph.step));
byId("zoom-out").addEventListener("click", () => graph.zoom(1 / graph.step));
byId("zoom-fit").addEventListener("click", () => graph.fit());
addEventListener("resize", () => charts.redraw());
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || byId("help").open) return;
  if (event.key === "Escape") {
    if (event.target === byId("search")) byId("search").value = "";
    names.apply();
    select(null);
    return;
  }
  if (event.target.matches("input")) return;
  const act = {
    "/": () => byId("search").focus(),
    n: () => byId("list").focus(),
    g: () => byId("graph").focus(),
    e: () => byId("events").focus(),
    t: switchTheme,
    "?": () => byId("help").showModal(),
    "+": () => graph.zoom(graph.step),
    "=": () => graph.zoom(graph.step),
    "-": () => graph.zoom(1 / graph.step),
    0: () => graph.fit(),
  }[event.key.toLowerCase()];
  if (!act) return;
  event.preventDefault();
  act();
});

legend();
connect();
