"use strict";
(() => {
  const data = JSON.parse(document.getElementById("map-data").textContent);
  const unpack = (text) => {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    const view = new DataView(bytes.buffer), values = new Float32Array(bytes.length / 4);
    for (let i = 0; i < values.length; i++) values[i] = view.getFloat32(4 * i, true);
    return values;
  };
  const place = unpack(data.place), q = unpack(data.q), row = unpack(data.row), inside = unpack(data.inside);
  const numbering = unpack(data.numbering), rowText = (i) => `${data.numberings[numbering[i]]} ${row[i]}`;
  const frame = unpack(data.frame), target = unpack(data.target);
  const count = row.length, dof = data.joints.length;
  const layers = data.layers.map((layer) => ({ ...layer, values: unpack(layer.values) }));
  const canvas = document.getElementById("canvas"), pen = canvas.getContext("2d");
  const byId = (id) => document.getElementById(id);
  // Dark to light in even steps of lightness ("viridis"), so that it holds in grey and for the colour blind.
  const ramp = ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];
  const START = { yaw: -0.7, pitch: 0.45, zoom: 1 };
  const state = { ...START, layer: Math.min(1, layers.length - 1), share: 1, own: false, chosen: -1, worst: -1 };

  // Middle and size of what is shown.
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < count; i++) for (let a = 0; a < 3; a++) {
    const v = place[3 * i + a];
    if (v < low[a]) low[a] = v;
    if (v > high[a]) high[a] = v;
  }
  const middle = low.map((v, a) => (v + high[a]) / 2);
  const size = Math.max(Math.hypot(...low.map((v, a) => high[a] - v)), 1);

  // Classes with round bounds; common to all layers of a unit, so that before and after can be compared.
  const classesOf = (those) => {
    let min = Infinity, max = 0;
    for (const layer of those) {
      const known = Array.from(layer.values.filter((v) => v > 0)).sort((a, b) => a - b);
      if (!known.length) continue;
      min = Math.min(min, known[Math.floor(known.length / 100)]);
      max = Math.max(max, known[known.length - 1]);
    }
    if (!(max > 0)) return [0, 1];
    min = Math.max(min, max / 1e5);
    const fine = max / min < 1000 ? [1, 1.5, 2, 3, 5, 7] : max / min < 20000 ? [1, 2, 5] : [1, 3];
    const bounds = [];
    for (let decade = Math.floor(Math.log10(min)) - 1; decade <= Math.ceil(Math.log10(max)); decade++)
      for (const step of fine) bounds.push(Number((step * 10 ** decade).toPrecision(2)));
    let first = 0;
    while (first + 1 < bounds.length && bounds[first + 1] <= min) first++;
    let last = bounds.length - 1;
    while (last > first + 1 && bounds[last - 1] >= max) last--;
    return [0, ...bounds.slice(first + 1, last + 1)];
  };
  const classify = (layer, edges) => {
    const cls = new Int8Array(count).fill(-1);
    for (let i = 0; i < count; i++) {
      const v = layer.values[i];
      if (!Number.isFinite(v)) continue;
      let k = edges.length - 2;
      while (k > 0 && v < edges[k]) k--;
      cls[i] = k;
    }
    return { edges, cls };
  };
  for (const layer of layers) {
    layer.common = classify(layer, classesOf(layers.filter((other) => other.unit === layer.unit)));
    layer.own = classify(layer, classesOf([layer]));
    layer.order = Array.from({ length: count }, (_, i) => i).filter((i) => layer.own.cls[i] >= 0)
      .sort((a, b) => layer.values[b] - layer.values[a]);
  }
  const scaleOf = (layer) => (state.own ? layer.own : layer.common);
  let room = 1; // Smaller dots in a small map.
  const crowd = Math.min(1, Math.sqrt(1500 / Math.max(count, 1)));
  const radius = (k, n) => room * (1.7 + (8.5 * k * (0.45 + 0.55 * crowd)) / Math.max(n - 1, 1));
  const color = (k, n) => ramp[Math.round((k * (ramp.length - 1)) / Math.max(n - 1, 1))];
  const sprites = new Map();
  const sprite = (k, n, scale) => {
    const key = `${k}/${n}/${scale}`;
    if (!sprites.has(key)) {
      const r = radius(k, n) * scale, image = document.createElement("canvas");
      image.width = image.height = Math.ceil(2 * r + 3);
      const ink = image.getContext("2d"), c = image.width / 2;
      ink.beginPath(); ink.arc(c, c, r, 0, 2 * Math.PI);
      ink.fillStyle = color(k, n); ink.fill();
      ink.lineWidth = 0.6 * scale; ink.strokeStyle = "rgba(128,128,128,0.8)"; ink.stroke();
      sprites.set(key, image);
    }
    return sprites.get(key);
  };

  const sx = new Float32Array(count), sy = new Float32Array(count), depth = new Float32Array(count);
  let shown = new Int32Array(0), width = 0, height = 0, dpr = 1, queued = false;
  const view = () => {
    const cy = Math.cos(state.yaw), sn = Math.sin(state.yaw), cp = Math.cos(state.pitch), sp = Math.sin(state.pitch);
    const k = (0.9 * Math.min(width, height) * state.zoom) / size;
    return (x, y, z) => {
      const u = (x - middle[0]) * cy - (y - middle[1]) * sn, v = (x - middle[0]) * sn + (y - middle[1]) * cy;
      const w = z - middle[2];
      return [width / 2 + k * u, height / 2 - k * (w * cp + v * sp), v * cp - w * sp];
    };
  };
  const choose = () => {
    const layer = layers[state.layer], wanted = Math.max(1, Math.round(layer.order.length * state.share));
    shown = Int32Array.from(layer.order.slice(0, wanted));
  };
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const line = (at, a, b) => {
    const p = at(...a), r = at(...b);
    pen.beginPath(); pen.moveTo(p[0], p[1]); pen.lineTo(r[0], r[1]); pen.stroke();
  };
  const box = (at) => {
    const corner = (i) => [0, 1, 2].map((a) => ((i >> a) & 1 ? high[a] : low[a]));
    pen.strokeStyle = css("--line"); pen.lineWidth = 1;
    for (let i = 0; i < 8; i++) for (let a = 0; a < 3; a++) if (!((i >> a) & 1)) line(at, corner(i), corner(i | (1 << a)));
    pen.fillStyle = css("--soft"); pen.font = "12px system-ui, sans-serif"; pen.textAlign = "center";
    for (let a = 0; a < 3; a++) {
      // The edge along this axis that is lowest on the screen (for z: farthest left) bears the numbers.
      let best = 0, score = -Infinity;
      for (let i = 0; i < 8; i++) if (!((i >> a) & 1)) {
        const p = at(...corner(i)), r = at(...corner(i | (1 << a)));
        const s = a === 2 ? -(p[0] + r[0]) : p[1] + r[1];
        if (s > score) { score = s; best = i; }
      }
      const from = corner(best), to = corner(best | (1 << a)), p = at(...from), r = at(...to);
      if (Math.hypot(p[0] - r[0], p[1] - r[1]) < 50) continue;
      const dx = a === 2 ? -22 : 0, dy = a === 2 ? 4 : 16;
      const on = (t, b) => p[b] + t * (r[b] - p[b]);
      pen.fillText((Math.round(low[a]) + 0).toFixed(0), on(0.1, 0) + dx, on(0.1, 1) + dy);
      pen.fillText((Math.round(high[a]) + 0).toFixed(0), on(0.9, 0) + dx, on(0.9, 1) + dy);
      pen.fillText(`${"xyz"[a]} [mm]`, (p[0] + r[0]) / 2 + 1.4 * dx, (p[1] + r[1]) / 2 + 1.2 * dy);
    }
  };
  const draw = () => {
    queued = false;
    pen.setTransform(dpr, 0, 0, dpr, 0, 0);
    pen.clearRect(0, 0, width, height);
    const at = view(), layer = layers[state.layer], { edges, cls } = scaleOf(layer), n = edges.length - 1;
    box(at);
    let back = -Infinity, front = Infinity;
    for (const i of shown) {
      const p = at(place[3 * i], place[3 * i + 1], place[3 * i + 2]);
      sx[i] = p[0]; sy[i] = p[1]; depth[i] = p[2];
      if (p[2] > back) back = p[2];
      if (p[2] < front) front = p[2];
    }
    // Far ones first: sorted into 256 drawers by depth.
    const drawers = 256, span = Math.max(back - front, 1e-9), start = new Int32Array(drawers + 1), sorted = new Int32Array(shown.length);
    const drawer = (i) => Math.min(drawers - 1, Math.floor(((back - depth[i]) / span) * drawers));
    for (const i of shown) start[drawer(i) + 1]++;
    for (let k = 0; k < drawers; k++) start[k + 1] += start[k];
    for (const i of shown) sorted[start[drawer(i)]++] = i;
    pen.setTransform(1, 0, 0, 1, 0, 0);
    for (const i of sorted) {
      const image = sprite(cls[i], n, dpr);
      pen.drawImage(image, sx[i] * dpr - image.width / 2, sy[i] * dpr - image.height / 2);
    }
    pen.setTransform(dpr, 0, 0, dpr, 0, 0);
    if (state.chosen >= 0) {
      const i = state.chosen, p = at(place[3 * i], place[3 * i + 1], place[3 * i + 2]);
      pen.strokeStyle = css("--ink"); pen.lineWidth = 2;
      pen.beginPath(); pen.arc(p[0], p[1], 13, 0, 2 * Math.PI); pen.stroke();
      pen.beginPath(); pen.arc(p[0], p[1], 17, 0, 2 * Math.PI); pen.stroke();
    }
    canvas.dataset.drawn = String(shown.length);
    canvas.dataset.view = [state.yaw, state.pitch, state.zoom].map((v) => v.toFixed(3)).join(" ");
  };
  const redraw = () => { if (!queued) { queued = true; requestAnimationFrame(draw); } };
  const fit = () => {
    const area = canvas.getBoundingClientRect();
    dpr = Math.min(window.devicePixelRatio || 1, 2);
    width = canvas.clientWidth || area.width; height = canvas.clientHeight || area.height;
    canvas.width = Math.round(width * dpr); canvas.height = Math.round(height * dpr);
    room = Math.max(0.6, Math.min(1, Math.min(width, height) / 600));
    sprites.clear(); legend(); redraw();
  };

  const text = (tag, content) => { const e = document.createElement(tag); e.textContent = content; return e; };
  const number = (v) => (Number.isFinite(v) ? (v !== 0 && Math.abs(v) < 1e-3 ? v.toExponential(1) : v.toPrecision(3)) : "unknown");
  const legend = () => {
    const layer = layers[state.layer], { edges, cls } = scaleOf(layer), n = edges.length - 1, body = byId("legend").tBodies[0];
    const counts = new Array(n).fill(0);
    for (const i of layer.order) counts[cls[i]]++;
    byId("legend").caption.textContent = `${layer.label} [${layer.unit}]`;
    body.replaceChildren();
    for (let k = n - 1; k >= 0; k--) {
      const line = document.createElement("tr"), cell = document.createElement("td");
      const r = radius(k, n), side = 2 * radius(n - 1, n) + 2;
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      svg.setAttribute("width", side); svg.setAttribute("height", Math.max(2 * r + 2, 8));
      const dot = document.createElementNS("http://www.w3.org/2000/svg", "circle");
      dot.setAttribute("cx", side / 2); dot.setAttribute("cy", Math.max(2 * r + 2, 8) / 2); dot.setAttribute("r", r);
      dot.setAttribute("fill", color(k, n)); dot.setAttribute("stroke", "#808080"); dot.setAttribute("stroke-width", "0.6");
      svg.append(dot); cell.append(svg);
      line.append(cell, text("td", k === 0 ? `below ${edges[1]}` : `${edges[k]} to ${edges[k + 1]}`), text("td", String(counts[k])));
      if (!counts[k]) line.className = "empty";
      body.append(line);
    }
    byId("layer-summary").textContent = layer.summary;
  };
  const tell = (i) => {
    const panel = byId("point");
    if (i < 0) return;
    const lines = [["x, y, z", `${[0, 1, 2].map((a) => (Math.round(place[3 * i + a]) + 0).toFixed(0)).join(", ")} mm`]];
    for (const layer of layers) lines.push([layer.label, `${number(layer.values[i])} ${Number.isFinite(layer.values[i]) ? layer.unit : ""}`]);
    lines.push(["joints", data.joints.map((joint, j) => `${q[dof * i + j].toFixed(1)}${joint.unit}`).join(", ")]);
    if (data.frames.length > 1) lines.push(["frame", data.frames[frame[i]] || "(no name)"]);
    if (data.targets.length > 1) lines.push(["target", data.targets[target[i]] || "(no name)"]);
    if (!inside[i]) lines.push(["", "outside the measured joint values"]);
    const table = document.createElement("table");
    for (const [name, value] of lines) {
      const line = document.createElement("tr");
      line.append(text("th", name), text("td", value)); table.append(line);
    }
    panel.replaceChildren(text("strong", row[i] > 0 ? rowText(i) : "sample"), table);
  };
  const nearest = (x, y, reach) => {
    let best = -1, least = reach * reach, front = Infinity;
    for (const i of shown) {
      const d = (sx[i] - x) ** 2 + (sy[i] - y) ** 2;
      if (d < least - 4 || (d < least + 4 && d < reach * reach && depth[i] < front)) { best = i; least = Math.min(d, least); front = depth[i]; }
    }
    return best;
  };
  const select = (i) => { state.chosen = i; tell(i); redraw(); };
  const show = (index) => {
    state.layer = index; state.worst = -1;
    [...byId("layers").children].forEach((button, k) => button.setAttribute("aria-pressed", String(k === index)));
    canvas.dataset.layer = layers[index].key;
    choose(); legend(); redraw();
  };
  const worst = () => {
    const order = layers[state.layer].order;
    if (!order.length) return;
    state.worst = (state.worst + 1) % order.length;
    select(order[state.worst]);
  };
  const turn = (dx, dy) => {
    state.yaw += dx; state.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, state.pitch + dy)); redraw();
  };
  const zoom = (factor) => { state.zoom = Math.max(0.4, Math.min(40, state.zoom * factor)); redraw(); };
  const views = {
    top: () => Object.assign(state, { yaw: 0, pitch: Math.PI / 2 }),
    front: () => Object.assign(state, { yaw: -Math.PI / 2, pitch: 0 }),
    side: () => Object.assign(state, { yaw: 0, pitch: 0 }),
    reset: () => { Object.assign(state, START, { chosen: -1, worst: -1 }); byId("point").textContent = "Point at a dot, or press “next worst”."; },
    worst,
  };

  layers.forEach((layer, index) => {
    const button = text("button", layer.label);
    button.type = "button"; button.dataset.layer = layer.key;
    button.addEventListener("click", () => show(index));
    byId("layers").append(button);
  });
  for (const button of document.querySelectorAll("[data-view]"))
    button.addEventListener("click", () => { views[button.dataset.view](); redraw(); });
  byId("own").addEventListener("change", (event) => { state.own = event.target.checked; legend(); redraw(); });
  byId("share").addEventListener("change", (event) => { state.share = Number(event.target.value); choose(); redraw(); });

  const fingers = new Map();
  let moved = 0, apart = 0;
  const local = (event) => { const area = canvas.getBoundingClientRect(); return [event.clientX - area.left, event.clientY - area.top]; };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, local(event)); moved = 0; apart = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = local(event), before = fingers.get(event.pointerId);
    if (!before) {
      const i = nearest(x, y, 14);
      if (i >= 0 && i !== state.chosen) select(i);
      return;
    }
    fingers.set(event.pointerId, [x, y]);
    if (fingers.size === 2) {
      const [a, b] = [...fingers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (apart) zoom(now / apart);
      apart = now; moved = 99;
    } else {
      moved += Math.abs(x - before[0]) + Math.abs(y - before[1]);
      turn((x - before[0]) * 0.008, (y - before[1]) * 0.008);
    }
  });
  const lift = (event) => {
    if (fingers.delete(event.pointerId) && event.type === "pointerup" && moved < 6) {
      const i = nearest(...local(event), event.pointerType === "touch" ? 28 : 14);
      if (i >= 0) select(i);
    }
    apart = 0;
  };
  canvas.addEventListener("pointerup", lift);
  canvas.addEventListener("pointercancel", lift);
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault(); zoom(Math.exp(-event.deltaY * 0.0015));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const keys = {
      ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
      "+": () => zoom(1.2), "=": () => zoom(1.2), "-": () => zoom(1 / 1.2), 0: () => { views.reset(); redraw(); }, w: worst,
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault(); keys[event.key]();
  });
  byId("viewer").csv = () => {
    const names = ["row", "frame", "target", ...data.joints.map((joint) => `${joint.name} [${joint.unit}]`), "x [mm]", "y [mm]", "z [mm]", ...layers.map((layer) => `${layer.label} [${layer.unit}]`)];
    const number = (v) => (Number.isFinite(v) ? String(Number(v.toPrecision(6))) : "");
    const rows = Array.from(row, (one, i) => [
      one > 0 ? rowText(i) : "", data.frames[frame[i]] ?? "", data.targets[target[i]] ?? "", ...data.joints.map((_, j) => number(q[dof * i + j])),
      ...[0, 1, 2].map((a) => number(place[3 * i + a])), ...layers.map((layer) => number(layer.values[i])),
    ]);
    return [names, ...rows];
  };
  new ResizeObserver(fit).observe(canvas);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  if (layers.length) show(state.layer);
  fit();
})();
