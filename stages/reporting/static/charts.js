"use strict";
/* Small charts as SVG. Everything that is text goes through textContent. */
const BanmoCharts = (() => {
  const NS = "http://www.w3.org/2000/svg";
  function svg(name, attributes, text) {
    const e = document.createElementNS(NS, name);
    for (const [k, v] of Object.entries(attributes || {})) e.setAttribute(k, v);
    if (text !== undefined) e.textContent = text;
    return e;
  }
  const short = (v) => (v === 0 ? "0" : Math.abs(v) >= 100 ? v.toFixed(0) : Math.abs(v) >= 1 ? v.toFixed(1) : Math.abs(v) >= 0.01 ? v.toFixed(3) : v.toExponential(0));

  /* A curve over x; `logarithmic` on the y axis; `marks` are [x, text] of upright lines. */
  function line(points, { width = 340, height = 120, logarithmic = false, low = null, high = null, start = null, end = null, percent = false, marks = [], label = "" } = {}) {
    const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
    const usable = points.filter((p) => Number.isFinite(p[1]) && (!logarithmic || p[1] > 0));
    if (!usable.length) { root.append(svg("text", { x: 8, y: 20 }, "no figures")); return { root, cursor() {} }; }
    const left = 40, right = width - 6, top = 8, bottom = height - 20, f = logarithmic ? Math.log : (v) => v;
    const xs = usable.map((p) => p[0]), ys = usable.map((p) => f(p[1]));
    const x0 = start === null ? Math.min(...xs) : start, x1 = end === null ? Math.max(...xs, x0 + 1e-9) : end;
    let y0 = low === null ? Math.min(...ys) : f(low), y1 = high === null ? Math.max(...ys) : f(high);
    if (y1 - y0 < 1e-12) { y0 -= 0.5; y1 += 0.5; }
    const X = (x) => left + ((x - x0) / (x1 - x0)) * (right - left), Y = (v) => bottom - ((f(v) - y0) / (y1 - y0)) * (bottom - top);
    for (const t of [0, 0.5, 1]) {
      const v = y0 + t * (y1 - y0), y = bottom - t * (bottom - top);
      root.append(svg("line", { x1: left, x2: right, y1: y, y2: y, class: "grid" }), svg("text", { x: left - 6, y: y + 4, "text-anchor": "end" }, percent ? `${Math.round(100 * v)} %` : short(logarithmic ? Math.exp(v) : v)));
    }
    let written = -1e9;
    for (const [x, text] of marks) {
      if (x < x0 || x > x1) continue;
      root.append(svg("line", { x1: X(x), x2: X(x), y1: top, y2: bottom, class: "grid" }));
      if (X(x) - written > 7 * text.length + 10) { root.append(svg("text", { x: X(x) + 3, y: height - 6 }, text)); written = X(x) + 3 + 7 * text.length - 14; }
    }
    const d = usable.map((p, i) => `${i ? "L" : "M"}${X(p[0]).toFixed(1)},${Y(p[1]).toFixed(1)}`).join("");
    root.append(svg("path", { d: `${d}L${X(xs[xs.length - 1])},${bottom}L${X(xs[0])},${bottom}Z`, class: "fillc" }), svg("path", { d, class: "curve" }));
    const hand = svg("line", { y1: top, y2: bottom, x1: left, x2: left, class: "cursor", visibility: "hidden" });
    root.append(hand);
    return {
      root,
      cursor(x) { hand.setAttribute("visibility", "visible"); hand.setAttribute("x1", X(x)); hand.setAttribute("x2", X(x)); },
      at(event) { const box = root.getBoundingClientRect(); const t = ((event.clientX - box.left) / box.width * width - left) / (right - left); return x0 + Math.max(0, Math.min(1, t)) * (x1 - x0); },
    };
  }

  /* Directions [azimuth, elevation] in degrees by clip, seen from above; front is down, as one stands before it. */
  function compass(clips) {
    const size = 340, c = size / 2, r = 128, root = svg("svg", { viewBox: `0 0 ${size} ${size}`, role: "img", "aria-label": "Directions from which the clips were filmed" });
    const at = (azimuth, elevation) => { const q = r * (1 - Math.max(-30, Math.min(90, elevation)) / 90 * 0.92) , a = azimuth * Math.PI / 180; return [c + q * Math.sin(a), c + q * Math.cos(a)]; };
    for (const e of [0, 30, 60]) root.append(svg("circle", { cx: c, cy: c, r: r * (1 - e / 90 * 0.92), fill: "none", class: "grid" }));
    for (let a = 0; a < 360; a += 45) { const [x, y] = at(a, 0); root.append(svg("line", { x1: c, y1: c, x2: x, y2: y, class: "grid" })); }
    for (const [name, a] of [["front", 0], ["its left", 90], ["back", 180], ["its right", 270]]) {
      const k = a * Math.PI / 180; root.append(svg("text", { x: c + (r + 26) * Math.sin(k), y: c + (r + 20) * Math.cos(k) + 4, "text-anchor": "middle" }, name));
    }
    clips.forEach((clip, k) => {
      const colour = `hsl(${(k * 137.5) % 360} 55% 48%)`, group = svg("g", { fill: colour, opacity: 0.75 });
      group.append(svg("title", {}, clip.name));
      for (const [a, e] of clip.directions) { const [x, y] = at(a, e); group.append(svg("circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: 2.6 })); }
      root.append(group);
    });
    return root;
  }
  return { line, compass, svg };
})();
