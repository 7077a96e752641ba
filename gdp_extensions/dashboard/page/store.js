// What the server sent last, with lookups; and what is selected.

export class Store {
  constructor() {
    this.version = -1;
    this.nodes = [];
    this.links = [];
    this.names = [];
    this.domains = [];
    this.clusters = [];
    this.events = [];
    this.replicas = [];
    this.drops = [];
    this.totals = {};
    this.waiting = {};
    this.clocks = {};
    this.nodeAt = new Map();
    this.nameAt = new Map();
    this.selected = null; // {kind: "node" | "name" | "link", id}
    this.trees = { id: "", rows: [] };
    this.unixS = 0;
    this.leftOut = 0;
  }

  setStructure(message) {
    this.version = message.version;
    this.leftOut = message.left_out;
    this.domains = message.domains.map(([id, label]) => ({ id, label: label || id.slice(0, 6) }));
    this.nodes = message.nodes.map(([id, role, label, domain, near]) => ({
      id, role, domain, near, label: label || id.slice(0, 6),
      isSwitch: role === "switch" || role === "leaf",
    }));
    this.links = message.links.map(([a, b, cost, mtu, ports]) => ({
      a, b, cost, mtu, ports, id: `${this.nodes[a].id} ${this.nodes[b].id}`, ab: 0, ba: 0, rtt: null, loss: 0,
    }));
    this.names = message.names.map(([id, label, kind, type, publishers, readers, servers, clients, holders = []]) => ({
      id, kind, type, publishers, readers, servers, clients, holders, rate: 0, lost: 0, label: label || `${id.slice(0, 6)}…`,
    }));
    this.clusters = message.clusters;
    this.nodeAt = new Map(this.nodes.map((each, at) => [each.id, at]));
    this.nameAt = new Map(this.names.map((each, at) => [each.id, at]));
  }

  setFigures(message) {
    if (message.version !== this.version) return false;
    this.unixS = message.unix_s;
    message.links.forEach(([ab, ba, rtt, loss], at) => Object.assign(this.links[at], { ab, ba, rtt, loss }));
    for (const each of this.names) each.rate = 0;
    for (const [at, [rate, lost]] of Object.entries(message.names)) Object.assign(this.names[at], { rate, lost });
    this.drops = message.drops;
    this.replicas = message.replicas;
    this.waiting = message.waiting;
    this.clocks = message.clocks;
    this.totals = message.totals;
    this.events = [...message.events.slice().reverse(), ...this.events].slice(0, 400);
    return message.events.length > 0;
  }

  node(id) {
    return this.nodes[this.nodeAt.get(id)];
  }

  name(id) {
    return this.names[this.nameAt.get(id)];
  }

  nodeText(id) {
    const node = this.node(id);
    return node ? node.label : id.slice(0, 6);
  }

  // Directed pairs of node indices that the selected name's trees use: key "from to".
  treeEdges() {
    const edges = new Set();
    if (!this.selected || this.selected.kind !== "name" || this.trees.id !== this.selected.id) return edges;
    const at = (id) => this.nodeAt.get(id);
    for (const [publisher, , via, from, to] of this.trees.rows) {
      const here = at(via);
      if (from) edges.add(`${at(from)} ${here}`);
      for (const each of to) edges.add(`${here} ${at(each)}`);
      const source = at(publisher);
      if (source !== undefined && this.links.some((link) => (link.a === source && link.b === here) || (link.b === source && link.a === here))) {
        edges.add(`${source} ${here}`);
      }
    }
    return edges;
  }

  nameEnds(name) {
    return new Set([...name.publishers, ...name.readers, ...name.servers, ...name.clients]);
  }
}
