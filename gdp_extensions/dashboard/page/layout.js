// Places of nodes: switches by forces between them, other nodes around their switch, on the side that is free.

const SPRING = 130;
const SATELLITE = 46;
const BUDGET_MS = 250;

// The order in which switches are met along links, so that a ring starts as a ring.
function walkOrder(switches, neighbours) {
  const seen = new Set();
  const order = [];
  for (const first of switches) {
    const stack = [first];
    while (stack.length) {
      const at = stack.pop();
      if (seen.has(at)) continue;
      seen.add(at);
      order.push(at);
      for (const next of neighbours.get(at) ?? []) if (!seen.has(next)) stack.push(next);
    }
  }
  return order;
}

export function place(store, before) {
  const switches = [];
  store.nodes.forEach((each, at) => each.isSwitch && switches.push(at));
  const neighbours = new Map(switches.map((at) => [at, []]));
  const home = new Map();
  const springs = [];
  for (const link of store.links) {
    const [a, b] = [link.a, link.b];
    if (neighbours.has(a) && neighbours.has(b)) {
      neighbours.get(a).push(b);
      neighbours.get(b).push(a);
      springs.push([a, b]);
    } else if (neighbours.has(a)) home.set(b, a);
    else if (neighbours.has(b)) home.set(a, b);
  }
  const order = walkOrder(switches, neighbours);
  const satellites = new Map(switches.map((at) => [at, 0]));
  for (const at of home.values()) satellites.set(at, satellites.get(at) + 1);
  const points = new Array(store.nodes.length);
  const radius = Math.max(SPRING, (order.length * SPRING) / (2 * Math.PI));
  const domains = [...new Set(order.map((at) => store.nodes[at].domain))];
  const isLarge = order.length > 12 && domains.length > 1;
  let isNew = false;
  order.forEach((at, number) => {
    const old = before.get(store.nodes[at].id);
    isNew ||= !old;
    const angle = (2 * Math.PI * number) / order.length - Math.PI / 2;
    points[at] = old ? { x: old.x, y: old.y } : { x: radius * Math.cos(angle), y: radius * 0.8 * Math.sin(angle) };
    if (old || !isLarge) return;
    // Each domain starts as a ring of its own, around its place among the domains.
    const domain = domains.indexOf(store.nodes[at].domain);
    const members = order.filter((each) => store.nodes[each].domain === store.nodes[at].domain);
    const turn = (2 * Math.PI * domain) / domains.length - (3 * Math.PI) / 4;
    const own = Math.max(SPRING, (members.length * SPRING) / (2 * Math.PI));
    const part = (2 * Math.PI * members.indexOf(at)) / members.length + turn + Math.PI;
    points[at] = { x: radius * 0.9 * Math.cos(turn) + own * Math.cos(part), y: radius * 0.7 * Math.sin(turn) + own * Math.sin(part) };
  });
  if (isNew) relax(order, springs, points, satellites, store, isLarge ? domains : []);
  surround(store, home, neighbours, points);
  return points;
}

function relax(order, springs, points, satellites, store, domains) {
  const n = order.length;
  const index = new Map(order.map((at, number) => [at, number]));
  const x = Float64Array.from(order, (at) => points[at].x);
  const y = Float64Array.from(order, (at) => points[at].y);
  const size = Float64Array.from(order, (at) => 1 + Math.min(satellites.get(at), 12) * 0.16);
  const pairs = springs.map(([a, b]) => {
    const isInside = store.nodes[a].domain === store.nodes[b].domain;
    return [index.get(a), index.get(b), isInside ? 1 : domains.length ? 2 : 1.35, isInside || !domains.length ? 0.06 : 0.012];
  });
  const groups = domains.map((domain) => order.flatMap((at, number) => (store.nodes[at].domain === domain ? [number] : [])));
  const fx = new Float64Array(n);
  const fy = new Float64Array(n);
  const end = performance.now() + BUDGET_MS;
  const steps = n > 80 ? 220 : 400;
  for (let step = 0; step < steps; step += 1) {
    const heat = 18 * (1 - step / steps) + 0.4;
    fx.fill(0);
    fy.fill(0);
    for (let i = 0; i < n; i += 1) {
      for (let j = i + 1; j < n; j += 1) {
        const dx = x[i] - x[j];
        const dy = y[i] - y[j];
        const squared = dx * dx + dy * dy + 60;
        const push = (SPRING * SPRING * size[i] * size[j] * 0.55) / squared;
        fx[i] += dx * push * 0.02;
        fy[i] += dy * push * 0.02;
        fx[j] -= dx * push * 0.02;
        fy[j] -= dy * push * 0.02;
      }
      fx[i] -= x[i] * 0.0012;
      fy[i] -= y[i] * 0.0022; // wider than high, as the canvas is
    }
    for (const [i, j, length, strength] of pairs) {
      const dx = x[j] - x[i];
      const dy = y[j] - y[i];
      const distance = Math.hypot(dx, dy) || 1;
      const pull = (strength * (distance - SPRING * length * Math.sqrt(size[i] * size[j]) * 0.9)) / distance;
      fx[i] += dx * pull;
      fy[i] += dy * pull;
      fx[j] -= dx * pull;
      fy[j] -= dy * pull;
    }
    separate(groups, x, y, fx, fy);
    for (let i = 0; i < n; i += 1) {
      const force = Math.hypot(fx[i], fy[i]) || 1;
      const move = Math.min(force, heat) / force;
      x[i] += fx[i] * move;
      y[i] += fy[i] * move;
    }
    if (step % 16 === 0 && performance.now() > end) break;
  }
  order.forEach((at, number) => Object.assign(points[at], { x: x[number], y: y[number] }));
}

// Keep the switches of a domain together, and domains apart.
function separate(groups, x, y, fx, fy) {
  const centres = groups.map((group) => {
    const mean = (values) => group.reduce((sum, i) => sum + values[i], 0) / group.length;
    return { x: mean(x), y: mean(y), radius: SPRING * (0.5 + 0.62 * Math.sqrt(group.length)) };
  });
  groups.forEach((group, at) => {
    const here = centres[at];
    let [dx, dy] = [0, 0];
    centres.forEach((other, number) => {
      if (number === at) return;
      const distance = Math.hypot(here.x - other.x, here.y - other.y) || 1;
      const overlap = here.radius + other.radius - distance;
      if (overlap > 0) {
        dx += ((here.x - other.x) / distance) * overlap * 0.12;
        dy += ((here.y - other.y) / distance) * overlap * 0.12;
      }
    });
    for (const i of group) {
      fx[i] += dx + (here.x - x[i]) * 0.018;
      fy[i] += dy + (here.y - y[i]) * 0.018;
    }
  });
}

function surround(store, home, neighbours, points) {
  const groups = new Map();
  store.nodes.forEach((node, at) => {
    if (node.isSwitch) return;
    const here = home.get(at);
    if (here === undefined) groups.set(-1, [...(groups.get(-1) ?? []), at]);
    else groups.set(here, [...(groups.get(here) ?? []), at]);
  });
  let low = 0;
  for (const point of points) if (point) low = Math.max(low, point.y);
  for (const [here, members] of groups) {
    if (here === -1) {
      members.forEach((at, number) => {
        points[at] = { x: (number - (members.length - 1) / 2) * 60, y: low + 150 };
      });
      continue;
    }
    const centre = points[here];
    const taken = neighbours.get(here).map((at) => Math.atan2(points[at].y - centre.y, points[at].x - centre.x)).sort((a, b) => a - b);
    let start = -Math.PI / 2;
    let gap = 2 * Math.PI;
    if (taken.length) {
      gap = 0;
      taken.forEach((angle, number) => {
        const next = number + 1 < taken.length ? taken[number + 1] : taken[0] + 2 * Math.PI;
        if (next - angle > gap) [gap, start] = [next - angle, angle];
      });
    } else start = -Math.PI / 2;
    const step = Math.min(gap / (members.length + 1), 0.9);
    const first = start + gap / 2 - (step * (members.length - 1)) / 2;
    members.sort((a, b) => (store.nodes[a].role < store.nodes[b].role ? 1 : -1));
    members.forEach((at, number) => {
      const far = SATELLITE * (1 + Math.max(0, 0.42 - step) * 1.1 * (number % 2 ? 1.2 : 0.4) + (step < 0.42 ? 0.3 : 0.15));
      const angle = first + step * number;
      points[at] = { x: centre.x + far * Math.cos(angle), y: centre.y + far * Math.sin(angle) };
    });
  }
}
