"use strict";
// Draws the report from the JSON in #report-data. Text in that JSON is HTML-escaped already;
// everything written into the page from here goes through textContent.
(() => {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const $ = (id) => document.getElementById(id);
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const plain = (text) => { const t = document.createElement("textarea"); t.innerHTML = text; return t.value; };
  const number = (v, digits = 2) => v === null || Number.isNaN(v) ? "not known" : v.toLocaleString("en", { maximumFractionDigits: digits });
  const STILL = { displayModeBar: false, responsive: true, scrollZoom: true };

  // ---- arrays -------------------------------------------------------------------------------
  const KINDS = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array };
  const cache = new Map();
  function array(encoded) {  // {values, rows, columns}; columns(c) gives one column
    if (!cache.has(encoded)) {
      const text = atob(encoded.data);
      const bytes = new Uint8Array(text.length);
      for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
      cache.set(encoded, new KINDS[encoded.type](bytes.buffer));
    }
    return cache.get(encoded);
  }
  function column(encoded, c) {
    const raw = array(encoded), width = encoded.shape[1] || 1, rows = encoded.shape[0];
    const out = encoded.scale ? new Float32Array(rows) : new Uint32Array(rows);
    const scale = encoded.scale ? encoded.scale[c] : 1, offset = encoded.scale ? encoded.offset[c] : 0;
    for (let i = 0; i < rows; i++) out[i] = raw[i * width + c] * scale + offset;
    return out;
  }
  const xyz = (encoded) => ({ x: column(encoded, 0), y: column(encoded, 1), z: column(encoded, 2) });
  const ijk = (encoded) => ({ i: column(encoded, 0), j: column(encoded, 1), k: column(encoded, 2) });

  // ---- colours: blue is missing, grey agrees, orange is too much ------------------------------
  const STOPS = [[8, 64, 129], [33, 113, 181], [94, 160, 211], [203, 207, 210], [240, 160, 92], [214, 92, 16], [133, 45, 2]];
  const HUES = 48, SHADES = 16;
  function hue(t) {  // t in −1..1
    const s = Math.min(Math.max((t + 1) / 2, 0), 1) * (STOPS.length - 1), n = Math.min(Math.floor(s), STOPS.length - 2);
    return STOPS[n].map((v, c) => v + (STOPS[n + 1][c] - v) * (s - n));
  }
  const PALETTE = [];
  for (let h = 0; h <= HUES; h++) for (let s = 0; s < SHADES; s++) {
    const light = 0.5 + 0.56 * s / (SHADES - 1);
    PALETTE.push("rgb(" + hue(2 * h / HUES - 1).map((v) => Math.round(Math.min(255, v * light))).join(",") + ")");
  }
  let range = data.scales[1];
  function pointColours(look) {
    const deviation = column(look.deviation, 0), shade = array(look.shade), out = new Array(deviation.length);
    for (let n = 0; n < out.length; n++) {
      const t = Math.min(Math.max(deviation[n] / range, -1), 1);
      out[n] = PALETTE[Math.round((t + 1) / 2 * HUES) * SHADES + shade[n]];
    }
    return out;
  }

  // ---- beads as tubes: six-sided, so that a layer reads as strands ----------------------------
  const SIDES = 6, FACES = 2 * SIDES + 2 * (SIDES - 2);
  const tubesOf = new Map();
  function tubes(beads) {
    if (tubesOf.has(beads)) return tubesOf.get(beads);
    const end = [0, 1, 2, 3, 4, 5].map((c) => column(beads.ends, c));
    const wide = column(beads.section, 0), high = column(beads.section, 1), layer = array(beads.layer);
    const count = layer.length, vertices = 2 * SIDES * count, faces = FACES * count;
    const out = { x: new Float32Array(vertices), y: new Float32Array(vertices), z: new Float32Array(vertices),
      i: new Uint32Array(faces), j: new Uint32Array(faces), k: new Uint32Array(faces), until: [], beads: [] };
    let v = 0, f = 0;
    for (let n = 0; n < count; n++) {
      const dx = end[3][n] - end[0][n], dy = end[4][n] - end[1][n], length = Math.hypot(dx, dy) || 1;
      const base = v, w = 0.46 * wide[n], h = 0.46 * high[n];
      for (let e = 0; e < 2; e++) for (let s = 0; s < SIDES; s++) {
        const angle = 2 * Math.PI * s / SIDES, across = w * Math.cos(angle);
        out.x[v] = end[3 * e][n] - dy / length * across;
        out.y[v] = end[3 * e + 1][n] + dx / length * across;
        out.z[v] = end[3 * e + 2][n] - high[n] / 2 + h * Math.sin(angle) / 0.8660254;
        v++;
      }
      const face = (a, b, c) => { out.i[f] = base + a; out.j[f] = base + b; out.k[f] = base + c; f++; };
      for (let s = 0; s < SIDES; s++) {
        const t = (s + 1) % SIDES;
        face(s, t, SIDES + s); face(t, SIDES + t, SIDES + s);
      }
      for (let s = 1; s < SIDES - 1; s++) { face(0, s + 1, s); face(SIDES, SIDES + s, SIDES + s + 1); }
      out.until[layer[n]] = f; out.beads[layer[n]] = (out.beads[layer[n]] || 0) + 1;
    }
    tubesOf.set(beads, out);
    return out;
  }
  function beadFaces(beads, layer) {
    const t = tubes(beads), from = layer > 0 ? t.until[layer - 1] : 0, to = t.until[layer];
    const part = (a, b) => ({ i: t.i.subarray(a, b), j: t.j.subarray(a, b), k: t.k.subarray(a, b) });
    return { past: part(0, from), now: part(from, to) };
  }

  // ---- traces -------------------------------------------------------------------------------
  const LIGHTING = { ambient: 0.62, diffuse: 0.55, specular: 0.12, roughness: 0.7, fresnel: 0.1, facenormalsepsilon: 0, vertexnormalsepsilon: 0 };
  const LIGHT = { x: 4000 * data.facing[0], y: 6000 * data.facing[1], z: 9000 };
  const LEFT = ["left_reach", "left_bead", "left_covered", "left_span"];  // what a repair does not fill, by cause
  const ORDER = ["scan", "ghost", "edges", "missing", "excess", "past", "now", "unseen", ...LEFT];
  const solid = (name, colour, mesh, opacity, extra) => Object.assign({
    type: "mesh3d", name, color: colour, opacity, flatshading: true, lighting: LIGHTING, lightposition: LIGHT,
    hoverinfo: "skip" }, mesh, extra || {});
  const none = { x: [], y: [], z: [], i: [], j: [], k: [] };
  let edgeLines = null;
  function edges() {
    if (edgeLines || !data.expected) return edgeLines || { x: [], y: [], z: [] };
    const v = xyz(data.expected.vertices), pairs = array(data.expected.edges), n = pairs.length / 2;
    const out = { x: new Array(3 * n), y: new Array(3 * n), z: new Array(3 * n) };
    for (let e = 0; e < n; e++) for (const c of "xyz") {
      out[c][3 * e] = v[c][pairs[2 * e]]; out[c][3 * e + 1] = v[c][pairs[2 * e + 1]]; out[c][3 * e + 2] = null;
    }
    return (edgeLines = out);
  }
  const meshOf = (m) => Object.assign(xyz(m.vertices), ijk(m.faces));
  function traces(look, shown, layer, size) {
    const see = (name) => shown.has(name);
    const faces = look.beads ? beadFaces(look.beads, layer) : null, t = look.beads ? tubes(look.beads) : none;
    const bead = (part) => faces ? Object.assign({ x: t.x, y: t.y, z: t.z }, faces[part]) : none;
    return [
      Object.assign({ type: "scatter3d", mode: "markers", name: "scan", visible: see("scan"),
        // squares are two triangles each; a disc is drawn as a glyph of dozens
        marker: { size, symbol: "square", color: pointColours(look), line: { width: 0 } },
        customdata: column(look.deviation, 0),
        hovertemplate: "deviation %{customdata:+.3f} mm<br>x %{x:.2f}, y %{y:.2f}, z %{z:.2f}<extra></extra>" }, xyz(look.points)),
      solid("ghost", css("--ghost"), data.expected ? meshOf(data.expected) : none, see("scan") ? 0.07 : 0.16, { visible: see("ghost") }),
      Object.assign({ type: "scatter3d", mode: "lines", name: "edges", visible: see("ghost"), hoverinfo: "skip", connectgaps: false,
        line: { color: css("--edge"), width: 1.6 } }, edges()),
      solid("missing", css("--missing"), look.missing ? meshOf(look.missing) : none, see("beads") ? 0.22 : see("scan") ? 0.75 : 1, { visible: see("missing") }),
      solid("excess", css("--excess"), look.excess ? meshOf(look.excess) : none, 1, { visible: see("excess") }),
      solid("past", css("--beads-past"), bead("past"), 1, { visible: see("beads") }),
      solid("now", css("--beads"), bead("now"), 1, { visible: see("beads") }),
      Object.assign({ type: "scatter3d", mode: "markers", name: "unseen", visible: see("unseen"), hoverinfo: "skip",
        marker: { size: 2, symbol: "square", color: css("--unseen"), line: { width: 0 }, opacity: 0.75 } }, look.unseen ? xyz(look.unseen) : { x: [], y: [], z: [] }),
      ...LEFT.map((name) => solid(name, css("--" + name.replace("_", "-")), look[name] ? meshOf(look[name]) : none, 1, { visible: see(name) })),
    ];
  }

  // ---- a scene ------------------------------------------------------------------------------
  const VIEWS = {  // direction to the eye, and which way is up
    overview: { eye: [0.88 * data.facing[0], 1.22 * data.facing[1], 0.82], up: [0, 0, 1] },
    top: { eye: [0, -0.0005, 1], up: [0, 1, 0] },
    front: { eye: [0, -1, 0], up: [0, 0, 1] },
    right: { eye: [1, 0, 0], up: [0, 0, 1] },
  };
  const copy = (v) => JSON.parse(JSON.stringify(v));
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a); return a.map((v) => v / n); };
  const point = (a) => ({ x: a[0], y: a[1], z: a[2] });
  const HALF_FIELD = Math.tan(Math.PI / 8);  // plotly's perspective sees 45° from top to bottom
  const ROOM = 0.86;  // the rest is for the numbers along the axes
  // As near as the whole box fits the pane: all eight corners are inside, whatever its shape.
  function cameraOf(name, pane) {
    const view = VIEWS[name], back = unit(view.eye), right = unit(cross(view.up, back)), up = cross(back, right);
    const side = [0, 1, 2].map((n) => data.bounds[1][n] - data.bounds[0][n]), mean = Math.cbrt(side[0] * side[1] * side[2]);
    const plot = pane.querySelector(".plot"), wide = Math.max(plot.clientWidth, 200) / Math.max(plot.clientHeight, 200);
    const corners = [...Array(8).keys()].map((n) => side.map((s, axis) => (n >> axis & 1 ? 0.5 : -0.5) * s / mean));
    let far = 0, center = [0, 0, 0];
    for (let turn = 0; turn < 4; turn++) {  // near corners look larger: what is in the middle moves
      const seen = corners.map((c) => { const d = c.map((v, axis) => v - center[axis]); return [dot(d, right), dot(d, up), dot(d, back)]; });
      far = Math.max(...seen.map(([x, y, z]) => z + Math.max(Math.abs(y), Math.abs(x) / wide) / (HALF_FIELD * ROOM)));
      const middle = (k) => { const at = seen.map((s) => s[k] / (far - s[2])); return 0.5 * (Math.min(...at) + Math.max(...at)) * far; };
      const [dx, dy] = [middle(0), middle(1)];
      if (turn < 3) center = center.map((v, axis) => v + dx * right[axis] + dy * up[axis]);
    }
    return { eye: point(center.map((v, axis) => v + back[axis] * far)), up: point(view.up), center: point(center), projection: { type: "perspective" } };
  }
  function axis(title, n) {
    return { title: { text: title, font: { size: 11, color: css("--ink-3") } }, range: [data.bounds[0][n], data.bounds[1][n]],
      color: css("--ink-3"), gridcolor: css("--grid"), linecolor: css("--line"), zeroline: false, showbackground: false,
      tickfont: { size: 10.5 }, nticks: 6, showspikes: false };
  }
  const layout3d = (camera) => ({
    margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)", showlegend: false, uirevision: "keep",
    font: { family: css("--sans") }, hoverlabel: { font: { family: css("--sans"), size: 12 } },
    scene: { aspectmode: "data", bgcolor: css("--scene"), camera, dragmode: "orbit",
      xaxis: axis("X, mm", 0), yaxis: axis("Y, mm", 1), zaxis: axis("Z, mm", 2) },
  });
  // Squares about as large as the points are apart, so that a surface closes without hiding detail.
  function pointSize(look, pane) {
    const side = [0, 1, 2].map((n) => data.bounds[1][n] - data.bounds[0][n]), [a, b, c] = side;
    const apart = Math.sqrt((a * b + 2 * (b * c + c * a)) / Math.max(look.shown, 1));
    const scale = 0.8 * Math.max(pane.clientHeight, 300) / Math.hypot(a, b, c);
    return Math.min(Math.max(1.9 * apart * scale, 1.8), 7);
  }
  const pending = [];
  // Paper has another width than the window, and nothing is drawn anew for it: what is drawn is
  // scaled there, by the style sheet.
  function scalable(div) {
    const fit = () => {
      const { width, height } = div._fullLayout;
      div.style.setProperty("--aspect", width + " / " + height);
      div.querySelectorAll(".main-svg").forEach((svg) => svg.setAttribute("viewBox", "0 0 " + width + " " + height));
    };
    if (!div.scalable && div.on) { div.scalable = true; div.on("plotly_afterplot", fit); fit(); }
  }
  class Scene {
    constructor(id) {
      this.pane = $(id); this.div = this.pane.querySelector(".plot");
      this.look = 0; this.layer = 0; this.shown = new Set(["scan", "ghost"]); this.linked = []; this.queue = Promise.resolve();
      this.camera = cameraOf("overview", this.pane);
      this.pane.addEventListener("keydown", (event) => this.key(event));
      // The wheel belongs to the page until the drawing has been chosen.
      this.pane.addEventListener("wheel", (event) => { if (!this.pane.contains(document.activeElement)) event.stopPropagation(); }, { capture: true });
      this.pane.addEventListener("pointerdown", () => this.pane.focus({ preventScroll: true }), { capture: true });
    }
    draw() {
      return this.then(() => Plotly.react(this.div, traces(data.looks[this.look], this.shown, this.layer, pointSize(data.looks[this.look], this.pane)),
        layout3d(this.camera), STILL).then(() => this.listen()));
    }
    then(step) {  // one change after the other: plotly's 3D scenes do not take two at once
      this.queue = this.queue.then(step).catch((error) => this.fail(error));
      pending.push(this.queue);
      return this.queue;
    }
    fail(error) {
      if (this.pane.querySelector(".failed")) return;
      const note = document.createElement("p");
      note.className = "failed";
      note.textContent = "This drawing needs WebGL, which this browser does not offer. The tables below hold every figure.";
      this.pane.append(note); console.warn(error);
    }
    listen() {
      scalable(this.div);
      if (this.listening || !this.div.on) return;
      this.listening = true;
      const moved = (change) => {
        const camera = change && change["scene.camera"];
        if (!camera || this.quiet) return;
        this.camera = copy(camera);
        this.linked.forEach((other) => other.turn(this.camera));
      };
      this.div.on("plotly_relayouting", moved); this.div.on("plotly_relayout", moved);
    }
    turn(camera) {
      this.camera = copy(camera); this.quiet = true;
      return this.then(() => Plotly.relayout(this.div, { "scene.camera": copy(this.camera) }).then(() => { this.quiet = false; }));
    }
    turnAll(camera) { this.turn(camera); this.linked.forEach((other) => other.turn(camera)); }
    restyle(change, names) { return this.then(() => Plotly.restyle(this.div, change, names.map((n) => ORDER.indexOf(n)))); }
    key(event) {
      if (event.target !== this.pane || event.altKey || event.ctrlKey || event.metaKey) return;
      const camera = copy(this.camera), at = camera.center || { x: 0, y: 0, z: 0 };
      const eye = { x: camera.eye.x - at.x, y: camera.eye.y - at.y, z: camera.eye.z - at.z };
      let radius = Math.hypot(eye.x, eye.y, eye.z), azimuth = Math.atan2(eye.y, eye.x), height = Math.asin(eye.z / radius);
      const step = Math.PI / 24;
      if (event.key === "ArrowLeft") azimuth -= step; else if (event.key === "ArrowRight") azimuth += step;
      else if (event.key === "ArrowUp") height += step; else if (event.key === "ArrowDown") height -= step;
      else if (event.key === "+" || event.key === "=") radius /= 1.12; else if (event.key === "-") radius *= 1.12;
      else if (event.key === "0") { event.preventDefault(); this.turnAll(cameraOf("overview", this.pane)); return; }
      else return;
      event.preventDefault();
      height = Math.min(Math.max(height, -1.5), 1.5);
      camera.up = { x: 0, y: 0, z: 1 };
      camera.eye = { x: at.x + radius * Math.cos(height) * Math.cos(azimuth), y: at.y + radius * Math.cos(height) * Math.sin(azimuth), z: at.z + radius * Math.sin(height) };
      this.turnAll(camera);
    }
  }

  // ---- charts -------------------------------------------------------------------------------
  const flat = (extra) => Object.assign({
    margin: { l: 58, r: 12, t: 10, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: css("--sans"), size: 12, color: css("--ink-2") }, showlegend: false, dragmode: false,
    hoverlabel: { font: { family: css("--sans"), size: 12 } } }, extra);
  const line = (title, extra) => Object.assign({ title: { text: title, font: { size: 12 }, standoff: 8 }, gridcolor: css("--line-soft"),
    linecolor: css("--line"), zeroline: false, ticks: "outside", tickcolor: css("--line"), ticklen: 4, automargin: true }, extra || {});
  const chart = (id, traceList, layout) => { if ($(id)) pending.push(Plotly.react(id, traceList, layout, { displayModeBar: false, responsive: true }).then(scalable)); };
  const FLAT_HUE = (t) => "rgb(" + hue(t).map(Math.round).join(",") + ")";
  function histogram(look) {
    const h = look.histogram, x = h.counts.map((_, n) => h.low + (n + 0.5) * h.step);
    const limit = (v) => ({ type: "line", x0: v, x1: v, yref: "paper", y0: 0, y1: 1, line: { color: css("--ink-2"), width: 1.2, dash: "dash" } });
    const inside = look.threshold !== null && look.threshold < -h.low;
    chart("histogram", [{ type: "bar", x, y: h.counts, width: h.step, marker: { color: x.map((v) => FLAT_HUE(v / range)), line: { width: 0 } },
      hovertemplate: "%{x:.3f} mm: %{y:,} points<extra></extra>" }],
      flat({ bargap: 0, shapes: inside ? [limit(-look.threshold), limit(look.threshold)] : [],
        annotations: inside ? [{ x: look.threshold, y: 1, yref: "paper", xanchor: "left", yanchor: "top", text: " limit ±" + number(look.threshold, 3) + " mm", showarrow: false, font: { size: 11.5 } }] : [],
        xaxis: line("Signed deviation, mm (negative: missing)", { range: [h.low, -h.low], showgrid: false }),
        yaxis: line("Points", { type: "log", dtick: 1, exponentformat: "none", tickformat: ",d" }) }));
    $("histogram-note").textContent = number(h.counts.reduce((a, b) => a + b, 0), 0) + " points of the part, on a logarithmic scale. " + (h.beyond ? number(h.beyond, 0) + (h.beyond === 1 ? " point beyond the ends is" : " points beyond the ends are") + " in the outermost bars." : "");
  }
  function noise(look) {
    const n = look.noise, figure = $("noise-figure");
    if (!figure) return;
    figure.hidden = !n.area.length;
    if (!n.area.length) return;
    chart("noise", [{ type: "scatter", mode: "lines+markers", x: n.area, y: n.depth, line: { color: css("--ink-2") },
      hovertemplate: "over %{x:.3~g} mm²: %{y:.2f} mm<extra></extra>" }],
      flat({ xaxis: line("Area of a defect, mm²", { type: "log", dtick: 1 }), yaxis: line("Depth, mm", { rangemode: "tozero" }) }));
    $("noise-note").textContent = plain(n.told);
  }
  function heights(look) {
    const h = look.heights, figure = $("heights-figure");
    if (!figure) return;
    figure.hidden = !h;
    if (!h) return;
    $("heights-title").textContent = plain(h.title);
    const [ny, nx] = h.shape, flatZ = column(h.z, 0), seen = array(h.seen), z = [];
    for (let r = 0; r < ny; r++) { const row = new Array(nx); for (let c = 0; c < nx; c++) row[c] = seen[r * nx + c] ? flatZ[r * nx + c] : null; z.push(row); }
    const along = (origin, n) => Array.from({ length: n }, (_, i) => origin + (i + 0.5) * h.cell);
    const outlines = { x: [], y: [] };
    h.outlines.forEach((o) => { o.concat([o[0]]).forEach(([x, y]) => { outlines.x.push(x); outlines.y.push(y); }); outlines.x.push(null); outlines.y.push(null); });
    const trace = (colour, width) => ({ type: "scatter", mode: "lines", x: outlines.x, y: outlines.y, line: { color: colour, width }, hoverinfo: "skip" });
    chart("heights", [{ type: "heatmap", x: along(h.origin[0], nx), y: along(h.origin[1], ny), z, colorscale: "Cividis", hoverongaps: false,
      colorbar: { title: { text: "Z, mm", font: { size: 12 } }, thickness: 12, outlinewidth: 0, len: 1, tickfont: { size: 11 } },
      hovertemplate: "x %{x:.1f}, y %{y:.1f}: %{z:.2f} mm<extra></extra>" }, trace("rgba(0,0,0,.75)", 4.5), trace("#ffffff", 2)],
      flat({ margin: { l: 52, r: 8, t: 10, b: 44 }, plot_bgcolor: css("--unseen"),
        xaxis: line("X, mm", { showgrid: false, constrain: "domain", range: [h.origin[0], h.origin[0] + nx * h.cell] }),
        yaxis: line("Y, mm", { showgrid: false, scaleanchor: "x", constrain: "domain", range: [h.origin[1], h.origin[1] + ny * h.cell] }) }));
  }
  function volumes() {
    const v = data.volumes, bar = (name, y, colour, pattern) => ({ type: "bar", name, x: v.label, y, marker: { color: colour, pattern: { shape: pattern, solidity: 0.25, fgcolor: css("--card"), fgopacity: 0.9, fillmode: "overlay" } },
      text: v.label.length <= 8 ? y.map((n) => n === null ? "" : number(n, Math.abs(n) < 10 ? 1 : 0)) : undefined, textposition: "outside", cliponaxis: false, hovertemplate: "%{y:,.2f} mm³ " + name + "<extra></extra>" });
    chart("volumes-chart", [bar("missing", v.missing, css("--missing"), ""), bar("too much", v.excess, css("--excess"), "/")],
      flat({ barmode: "group", bargap: 0.35, showlegend: true, legend: { orientation: "h", x: 0, y: 1.14 }, margin: { l: 58, r: 12, t: 34, b: 44 },
        xaxis: line("", { type: "category", showgrid: false, tickangle: v.label.length > 4 ? -30 : 0, showticklabels: v.label.length <= 24 }),
        yaxis: line("Volume, mm³", { rangemode: "tozero" }) }));
  }
  function temperatures() {
    const colours = [css("--excess"), css("--missing"), css("--beads"), css("--unseen")], out = [];
    const long = Math.max(...data.temperatures.map((s) => s.time[s.time.length - 1] || 0)) > 600;  // s
    const when = (s) => long ? s.time.map((t) => t / 60) : s.time;
    data.temperatures.forEach((s, n) => {
      const colour = colours[n % colours.length];
      if (s.target) out.push({ type: "scatter", mode: "lines", x: when(s), y: s.target, name: s.name + " target", connectgaps: true, line: { color: colour, width: 1.2, dash: "dot", shape: "hv" }, hovertemplate: "%{y:.0f} °C<extra>%{fullData.name}</extra>" });
      out.push({ type: "scatter", mode: s.time.length < 40 ? "lines+markers" : "lines", x: when(s), y: s.measured, name: s.name, line: { color: colour, width: 1.9 }, hovertemplate: "%{y:.1f} °C<extra>%{fullData.name}</extra>" });
    });
    chart("temperatures", out, flat({ showlegend: true, legend: { orientation: "h", x: 0, y: 1.14 }, margin: { l: 58, r: 12, t: 34, b: 44 }, hovermode: "x unified",
      xaxis: line(long ? "Minutes since the run began" : "Seconds since the run began", { tickformat: "," }), yaxis: line("°C", { rangemode: "tozero" }) }));
  }

  // ---- legend -------------------------------------------------------------------------------
  function legend() {
    const bar = $("ramp"), ticks = $("ramp-ticks");
    if (!bar) return;
    bar.style.background = "linear-gradient(to top," + STOPS.map((c) => "rgb(" + c.join(",") + ")").join(",") + ")";
    ticks.replaceChildren();
    const threshold = data.looks[main.look].threshold;
    const mark = (value, text, kind) => { const s = document.createElement("span"); s.textContent = text; s.className = kind || ""; s.style.top = 50 - 46 * value / range + "%"; ticks.append(s); };
    mark(range, "+" + number(range, 3) + " too much"); mark(0, "0"); mark(-range, "−" + number(range, 3) + " missing");
    if (threshold !== null && threshold > 0.14 * range && threshold < 0.86 * range) { mark(threshold, "limit +" + number(threshold, 3), "limit"); mark(-threshold, "limit −" + number(threshold, 3), "limit"); }
  }

  // ---- wiring -------------------------------------------------------------------------------
  let main = null, before = null, after = null, timer = null;
  const PRESETS = { deviation: ["scan", "ghost"], defects: ["ghost", "missing", "excess", "unseen"], repair: ["ghost", "missing", "beads", ...LEFT] };
  const present = (look, name) => name === "scan" || (name === "ghost" ? !!data.expected : !!look[name]);
  function boxes() {
    document.querySelectorAll("input[data-layer]").forEach((box) => {
      const there = present(data.looks[main.look], box.dataset.layer);
      box.checked = main.shown.has(box.dataset.layer) && there; box.disabled = !there;
      box.parentElement.classList.toggle("absent", !there);
    });
  }
  function show(names) { main.shown = new Set(names); boxes(); main.draw(); }
  function preset(name, draw = true) {
    document.querySelectorAll("input[name=preset]").forEach((r) => { r.checked = r.value === name; });
    main.shown = new Set(PRESETS[name]); boxes();
    if (draw) main.draw();
  }
  function layerText() {
    const beads = data.looks[main.look].beads, player = $("player");
    if (!player) return;
    player.hidden = !beads;
    if (!beads) { stop(); return; }
    const slider = $("layer"), count = beads.tops.length, n = main.layer;
    slider.max = count - 1; slider.value = n;
    const text = "Layer " + (n + 1) + " of " + count + " · z " + beads.tops[n].toFixed(2) + " mm · " + number(tubes(beads).beads[n], 0) + " bead segments";
    $("layer-text").textContent = text + (beads.shown < beads.total ? " (" + number(beads.shown, 0) + " of " + number(beads.total, 0) + " drawn)" : "");
    slider.setAttribute("aria-valuetext", text);
  }
  function toLayer(n) {
    main.layer = n; layerText();
    if (!main.shown.has("beads")) { preset("repair"); return; }
    const beads = data.looks[main.look].beads;
    main.then(() => {
      const faces = beadFaces(beads, main.layer), pick = (c) => [faces.past[c], faces.now[c]];
      return Plotly.restyle(main.div, { i: pick("i"), j: pick("j"), k: pick("k") }, [ORDER.indexOf("past"), ORDER.indexOf("now")]);
    });
  }
  function stop() {
    if (timer) clearInterval(timer);
    timer = null;
    const button = $("play");
    if (button) { button.firstElementChild.textContent = "▶"; button.setAttribute("aria-label", "Play the repair layer by layer"); }
  }
  function play() {
    if (timer) { stop(); return; }
    const last = data.looks[main.look].beads.tops.length - 1;
    toLayer(main.layer >= last ? 0 : main.layer);
    const button = $("play");
    button.firstElementChild.textContent = "❚❚"; button.setAttribute("aria-label", "Pause");
    timer = setInterval(() => { if (main.layer >= last) stop(); else toLayer(main.layer + 1); }, Math.max(120, Math.min(600, 9000 / (last + 1))));
  }
  function selectLook(n) {
    stop();
    main.look = n;
    const look = data.looks[n], beads = look.beads;
    main.layer = beads ? beads.tops.length - 1 : 0;
    boxes(); layerText(); legend(); histogram(look); noise(look); heights(look);
    $("scene-note").textContent = look.shown < look.total
      ? "Drawn: " + number(look.shown, 0) + " of the scan's " + number(look.total, 0) + " points" + (look.flagged ? ", those beyond the limit first." : ".") + " The others show the bed or stray reflections, or are left out to keep this file small; volumes and decisions use every point."
      : "All " + number(look.total, 0) + " points are drawn.";
    main.draw();
  }
  function compared(scene, id) {
    const look = data.looks[scene.look];
    const volume = (v) => v === null ? "not known how much" : number(v, 1) + " mm³";
    $(id + "-figure").textContent = volume(data.volumes.missing[look.index]) + " missing · " + volume(data.volumes.excess[look.index]) + " too much";
    return scene.draw();
  }
  function theme() {
    if (main) { main.draw(); histogram(data.looks[main.look]); noise(data.looks[main.look]); heights(data.looks[main.look]); legend(); }
    if (before) { before.draw(); after.draw(); }
    if ($("volumes-chart")) volumes();
    if ($("temperatures")) temperatures();
  }
  function start() {
    if ($("viewer")) {
      main = new Scene("viewer");
      const select = $("range");
      [...new Set(data.scales)].forEach((v) => { const o = document.createElement("option"); o.value = v; o.textContent = "±" + number(v, 3) + " mm"; select.append(o); });
      select.value = range;
      select.addEventListener("change", () => { range = Number(select.value); legend(); main.draw(); histogram(data.looks[main.look]); if (before) { before.draw(); after.draw(); } });
      $("look").addEventListener("change", (e) => selectLook(Number(e.target.value)));
      document.querySelectorAll("input[name=preset]").forEach((r) => r.addEventListener("change", () => preset(r.value)));
      document.querySelectorAll("input[data-layer]").forEach((box) => box.addEventListener("change", () => {
        if (box.checked) main.shown.add(box.dataset.layer); else main.shown.delete(box.dataset.layer);
        show(main.shown);
      }));
      document.querySelectorAll("[data-view]").forEach((b) => b.addEventListener("click", () => main.turn(cameraOf(b.dataset.view, main.pane))));
      if ($("player")) { $("layer").addEventListener("input", (e) => { stop(); toLayer(Number(e.target.value)); }); $("play").addEventListener("click", play); }
      $("look").value = data.compare[0];
      selectLook(data.compare[0]);
    }
    if ($("before")) {
      before = new Scene("before"); after = new Scene("after");
      before.linked = [after]; after.linked = [before];
      [[before, "before", 0], [after, "after", 1]].forEach(([scene, id, n]) => {
        scene.look = data.compare[n]; $(id + "-look").value = scene.look;
        $(id + "-look").addEventListener("change", (e) => { scene.look = Number(e.target.value); compared(scene, id); });
        compared(scene, id);
      });
    }
    if ($("volumes-chart")) volumes();
    if ($("temperatures")) temperatures();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", theme);
    matchMedia("print").addEventListener("change", theme);
    const folds = document.querySelectorAll("details");
    addEventListener("beforeprint", () => folds.forEach((fold) => { fold.was = fold.open; fold.open = true; }));
    addEventListener("afterprint", () => folds.forEach((fold) => { fold.open = fold.was; }));
  }
  start();
  // For tests and for pages that embed this one: resolves when every drawing so far is done.
  window.reportSettled = async () => { let n = -1; while (n !== pending.length) { n = pending.length; await Promise.all(pending); } };
  window.reportState = () => ({ main, before, after });
})();
