// Panels at the side: what is selected, clusters, replicas, drops and events.

import { bits, clock, count, element, millis, perSecond } from "./format.js";

const ROWS_MAX = 12;
const ENDS_MAX = 30;

// Rows of trees in the order in which messages pass the switches.
function alongTree(rows) {
  const below = new Map(rows.map((row) => [`${row[0]} ${row[1]} ${row[2]}`, row]));
  const isFirst = (row) => !below.has(`${row[0]} ${row[1]} ${row[3]}`);
  const ordered = [];
  const visit = (row) => {
    if (!row || ordered.includes(row)) return;
    ordered.push(row);
    for (const next of row[4]) visit(below.get(`${row[0]} ${row[1]} ${next}`));
  };
  rows.filter(isFirst).forEach(visit);
  return [...ordered, ...rows.filter((row) => !ordered.includes(row))];
}

export class Panels {
  constructor(store, onSelect) {
    this.store = store;
    this.onSelect = onSelect;
    this.parts = Object.fromEntries(["detail", "clusters", "clusters-card", "replicas", "drops", "events", "totals"].map((id) => [id, document.getElementById(id)]));
  }

  drawSelection() {
    this.drawDetail();
    this.drawReplicas();
  }

  to(kind, id, text) {
    return element("button", { class: "link", type: "button", onclick: () => this.onSelect({ kind, id }) }, text);
  }

  put(part, ...children) {
    const holder = this.parts[part];
    const key = document.activeElement && holder.contains(document.activeElement) ? document.activeElement.textContent : null;
    holder.replaceChildren(...children);
    if (key === null) return; // the keyboard stays where it was
    const same = [...holder.querySelectorAll("button")].find((each) => each.textContent === key);
    same?.focus({ preventScroll: true });
  }

  table(rows, ...heads) {
    const isNumber = (cell, at) => at > 0 && typeof cell !== "object";
    const columns = rows[0]?.map(isNumber) ?? [];
    const line = (tag, cells) => element("tr", {}, ...cells.map((cell, at) => element(tag, { class: columns[at] ? "number" : undefined }, cell)));
    return element("table", {}, ...(heads.length ? [element("thead", {}, line("th", heads))] : []), element("tbody", {}, ...rows.map((row) => line("td", row))));
  }

  drawTotals() {
    const { totals, nodes, links, names } = this.store;
    const pairs = [
      ["Nodes", count(nodes.length)],
      ["Links", count(links.length)],
      ["Names", count(names.length)],
      ["Traffic", bits(totals.bytes_s ?? 0)],
      ["Messages", perSecond(totals.messages_s ?? 0)],
      ["Drops", perSecond(totals.drops_s ?? 0)],
    ];
    this.put("totals", ...pairs.map(([key, value]) => element("div", {}, element("dt", {}, key), element("dd", {}, value))));
  }

  drawDetail() {
    const { selected } = this.store;
    const draw = { node: () => this.nodeDetail(), name: () => this.nameDetail(), link: () => this.linkDetail() }[selected?.kind];
    const parts = draw?.();
    if (parts) this.put("detail", ...parts);
    else {
      const far = this.store.nodes.filter((each) => !each.near).length;
      const lines = [element("h2", {}, "Selection"), element("p", {}, "Select a name to see its path and tree, or a node or a link to see its figures.")];
      if (far) lines.push(element("p", {}, `${far} nodes run elsewhere: their links are known from their neighbours.`));
      if (this.store.leftOut) lines.push(element("p", {}, `${count(this.store.leftOut)} entries are left out: the nodes have more than one picture holds.`));
      this.put("detail", ...lines);
    }
  }

  nodeDetail() {
    const { store } = this;
    const node = store.node(store.selected.id);
    if (!node) return [element("h2", {}, "Node"), element("p", {}, "It is gone.")];
    const at = store.nodeAt.get(node.id);
    const domain = store.domains.find((each) => each.id === node.domain)?.label ?? "";
    const links = store.links.filter((each) => each.a === at || each.b === at);
    const names = store.names.filter((each) => store.nameEnds(each).has(at));
    const rows = links.slice(0, ROWS_MAX).map((link) => {
      const other = store.nodes[link.a === at ? link.b : link.a];
      return [this.to("node", other.id, other.label), bits(link.ab + link.ba), millis(link.rtt), link.loss ? `${(100 * link.loss).toFixed(1)} %` : "0"];
    });
    const parts = [
      element("h3", {}, node.label),
      element("p", {}, `${node.role} in ${domain}, ${node.id}${node.near ? "" : "; runs elsewhere"}`),
    ];
    for (const reason of store.waiting[node.id] ?? []) parts.push(element("p", { class: "bad" }, `waits: ${reason}`));
    parts.push(this.table(rows, "link to", "rate", "RTT", "loss"));
    if (links.length > ROWS_MAX) parts.push(element("p", {}, `and ${links.length - ROWS_MAX} more links`));
    const clocks = (store.clocks[node.id] ?? []).slice(0, ROWS_MAX);
    if (clocks.length) parts.push(this.table(clocks.map(([id, label, offset, bound]) => [this.to("node", id, label), offset.toFixed(1), bound.toFixed(1)]), "clock of", "ahead, ms", "± ms"));
    if (names.length) {
      parts.push(element("h2", {}, `Its names (${names.length})`));
      parts.push(this.table(names.slice(0, ROWS_MAX).map((name) => [this.to("name", name.id, name.label), this.uses(name, at)])));
      if (names.length > ROWS_MAX) parts.push(element("p", {}, `and ${names.length - ROWS_MAX} more; search the list for ${node.label}`));
    }
    return parts;
  }

  uses(name, at) {
    const words = [];
    if (name.publishers.includes(at)) words.push("publishes");
    if (name.readers.includes(at)) words.push("reads");
    if (name.servers.includes(at)) words.push("serves");
    if (name.clients.includes(at)) words.push("calls");
    if (name.holders.includes(at)) words.push("controls");
    return words.join(", ");
  }

  nameDetail() {
    const { store } = this;
    const name = store.name(store.selected.id);
    if (!name) return [element("h2", {}, "Name"), element("p", {}, "It is no longer used.")];
    const rows = [["publishers", "publishes"], ["readers", "reads"], ["servers", "serves"], ["clients", "calls"], ["holders", "controls"]].flatMap(([key, verb]) =>
      name[key].slice(0, ENDS_MAX).map((at) => [this.to("node", store.nodes[at].id, store.nodes[at].label), verb]));
    const hops = store.trees.id === name.id ? alongTree(store.trees.rows) : [];
    const parts = [
      element("h3", {}, name.label),
      element("p", {}, [name.type || name.kind, name.id].filter(Boolean).join(", ")),
      this.table([["messages", perSecond(name.rate)], ["lost so far", count(name.lost)]]),
      element("h2", {}, "Who uses it"),
      rows.length ? this.table(rows) : element("p", { class: "none" }, "nodes elsewhere"),
    ];
    if (hops.length) {
      parts.push(element("h2", {}, "Its tree, switch by switch"));
      parts.push(this.table(hops.slice(0, ENDS_MAX).map(([publisher, path, via, , to]) => [
        this.to("node", via, store.nodeText(via)),
        element("span", {}, `→ ${to.map((each) => store.nodeText(each)).join(", ") || "no node yet"}`),
        element("span", {}, `from ${store.nodeText(publisher)}${path === 2 ? ", second path" : ""}`),
      ])));
    } else parts.push(element("p", { class: "none" }, "No tree: no reader asks for it now."));
    return parts;
  }

  linkDetail() {
    const { store } = this;
    const link = store.links.find((each) => each.id === store.selected.id);
    if (!link) return [element("h2", {}, "Link"), element("p", {}, "It is lost.")];
    const [a, b] = [store.nodes[link.a], store.nodes[link.b]];
    return [
      element("h3", {}, `${a.label} – ${b.label}`),
      element("p", {}, link.ports.length ? `devices ${link.ports.join(", ")}` : "elsewhere: known from link states"),
      this.table([
        [`${a.label} → ${b.label}`, bits(link.ab)],
        [`${b.label} → ${a.label}`, bits(link.ba)],
        ["round trip", millis(link.rtt)],
        ["loss", `${(100 * link.loss).toFixed(2)} %`],
        ["cost", count(link.cost)],
        ["MTU", link.mtu ? `${count(link.mtu)} bytes` : "–"],
      ]),
    ];
  }

  drawReplicas() {
    const { store } = this;
    const selected = store.selected?.kind === "name" ? store.selected.id : null;
    const rows = store.replicas.filter((each) => !selected || each[0] === selected);
    const total = new Map();
    for (const [name, client, , , first] of rows) total.set(name + client, (total.get(name + client) ?? 0) + first);
    const shown = rows.slice(0, ROWS_MAX).map(([name, client, server, isThere, first, rate]) => {
      const share = first / (total.get(name + client) || 1);
      const bar = element("i");
      bar.style.width = `${100 * share}%`;
      return [
        element("span", {}, element("span", { class: isThere ? undefined : "gone" }, store.nodeText(server)), element("div", { class: "bar" }, bar)),
        this.to("name", name, store.name(name)?.label ?? name.slice(0, 6)),
        count(first),
        rate ? perSecond(rate) : "",
      ];
    });
    this.put("replicas", shown.length ? this.table(shown, "replica", "service", "first", "") : element("p", { class: "none" }, "No client here calls a service."));
    if (rows.length > ROWS_MAX) this.parts.replicas.append(element("p", {}, `and ${rows.length - ROWS_MAX} more`));
  }

  drawDrops() {
    const { store } = this;
    const rows = store.drops.slice(0, ROWS_MAX).map(([node, reason, total, rate]) => [
      element("span", { class: rate ? "bad" : undefined }, reason),
      this.to("node", node, store.nodeText(node)),
      count(total),
      rate ? perSecond(rate) : "",
    ]);
    this.put("drops", rows.length ? this.table(rows, "reason", "node", "so far", "now") : element("p", { class: "none" }, "Nothing was dropped."));
    if (store.drops.length > ROWS_MAX) this.parts.drops.append(element("p", {}, `and ${store.drops.length - ROWS_MAX} more`));
  }

  drawEvents() {
    this.parts.events.replaceChildren(...this.store.events.slice(0, 150).map((each) =>
      element("li", { class: each.is_bad ? "bad" : undefined }, element("time", {}, clock(each.unix_s)), element("span", {}, each.text))));
    if (!this.store.events.length) this.parts.events.append(element("li", { class: "none whole" }, "Nothing has changed since this view began."));
  }

  drawClusters() {
    const { clusters } = this.store;
    this.parts["clusters-card"].hidden = !clusters.length;
    const parts = clusters.flatMap((cluster) => {
      const machines = Array.isArray(cluster.machines) ? cluster.machines : [];
      return [
        element("p", {}, `${cluster.name}: ${cluster.serving} of ${cluster.wanted} serve, $${Number(cluster.usd_per_hour ?? 0).toFixed(3)} an hour`),
        this.table(machines.slice(0, ENDS_MAX).map((each) => [
          element("span", { class: each.stage === "preempted" || each.stage === "failed" ? "bad" : undefined }, each.name),
          element("span", {}, each.stage),
          element("span", {}, `${each.type ?? ""} ${each.spot ? "spot" : ""}`),
          each.region ?? "",
        ]), "machine", "state", "type", "region"),
      ];
    });
    this.put("clusters", ...parts);
  }
}
