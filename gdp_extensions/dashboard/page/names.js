// List of names: only the rows in view exist, so thousands cost as much as twenty.

import { element, perSecond } from "./format.js";

const ROW = 46;

export class NameList {
  constructor(store, onSelect) {
    this.store = store;
    this.onSelect = onSelect;
    this.list = document.getElementById("list");
    this.space = document.getElementById("list-space");
    this.search = document.getElementById("search");
    this.filter = "all";
    this.shown = [];
    this.at = -1;
    this.list.addEventListener("scroll", () => this.draw());
    this.search.addEventListener("input", () => this.apply());
    this.search.addEventListener("keydown", (event) => {
      if (event.key === "ArrowDown") {
        event.preventDefault();
        this.list.focus();
        this.move(0);
      } else if (event.key === "Enter" && this.shown.length) this.select(Math.max(this.at, 0));
    });
    this.list.addEventListener("keydown", (event) => this.key(event));
    this.list.addEventListener("click", (event) => {
      const row = event.target.closest(".row");
      if (row) this.select(Number(row.dataset.at));
    });
    for (const button of document.querySelectorAll("[data-filter]")) {
      button.addEventListener("click", () => {
        this.filter = button.dataset.filter;
        for (const each of document.querySelectorAll("[data-filter]")) each.setAttribute("aria-pressed", each === button);
        this.apply();
      });
    }
    new ResizeObserver(() => this.draw()).observe(this.list);
  }

  apply() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const nodes = this.store.nodes;
    this.shown = this.store.names.filter((name) => {
      if (this.filter === "topic" && name.kind !== "topic") return false;
      if (this.filter === "service" && name.kind === "topic") return false;
      if (this.filter === "active" && !name.rate) return false;
      if (!words.length) return true;
      const text = `${name.label} ${name.type} ${name.id} ${[...this.store.nameEnds(name)].map((at) => nodes[at]?.label).join(" ")}`.toLowerCase();
      return words.every((word) => text.includes(word));
    });
    this.shown.sort((a, b) => (a.label < b.label ? -1 : 1));
    const total = this.store.names.length;
    document.getElementById("names-count").textContent = this.shown.length === total ? String(total) : `${this.shown.length} of ${total}`;
    this.at = Math.min(this.at, this.shown.length - 1);
    this.space.style.height = `${this.shown.length * ROW}px`;
    this.draw();
  }

  key(event) {
    const page = Math.max(Math.floor(this.list.clientHeight / ROW) - 1, 1);
    const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -1e9, End: 1e9 };
    if (event.key in steps) this.move(steps[event.key]);
    else if (event.key === "Enter" || event.key === " ") this.select(this.at);
    else return;
    event.preventDefault();
  }

  move(step) {
    if (!this.shown.length) return;
    this.at = Math.min(Math.max(this.at + step, 0), this.shown.length - 1);
    const top = this.at * ROW;
    if (top < this.list.scrollTop) this.list.scrollTop = top;
    if (top + ROW > this.list.scrollTop + this.list.clientHeight) this.list.scrollTop = top + ROW - this.list.clientHeight;
    this.draw();
  }

  select(at) {
    if (at < 0 || at >= this.shown.length) return;
    this.at = at;
    this.onSelect({ kind: "name", id: this.shown[at].id });
  }

  draw() {
    const first = Math.max(Math.floor(this.list.scrollTop / ROW) - 2, 0);
    const last = Math.min(first + Math.ceil(this.list.clientHeight / ROW) + 4, this.shown.length);
    const rows = [];
    for (let at = first; at < last; at += 1) rows.push(this.row(this.shown[at], at));
    this.space.replaceChildren(...rows);
    this.list.setAttribute("aria-activedescendant", this.at >= first && this.at < last ? `row-${this.at}` : "");
  }

  row(name, at) {
    const isChosen = this.store.selected?.kind === "name" && this.store.selected.id === name.id;
    const sources = name.publishers.length + name.servers.length;
    const sinks = name.readers.length + name.clients.length;
    const row = element(
      "div",
      { class: at === this.at ? "row at" : "row", role: "option", id: `row-${at}`, "data-at": at, "aria-selected": String(isChosen) },
      element("b", {}, name.label),
      element("span", { class: "rate" }, name.rate ? perSecond(name.rate) : ""),
      element("span", {}, name.type || name.kind || "name"),
      element("span", { class: "ends", title: "publishers or servers, readers or clients" }, `${sources} → ${sinks}`),
    );
    row.style.top = `${at * ROW}px`;
    return row;
  }
}
