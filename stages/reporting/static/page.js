"use strict";
/* Puts the page together from #data, and from #provenance where whoever copied the report put it in. */
(() => {
  const $ = (id) => document.getElementById(id);
  const data = JSON.parse($("data").textContent);
  const provenance = JSON.parse($("provenance").textContent);
  const make = (name, cls, text) => { const e = document.createElement(name); if (cls) e.className = cls; if (text !== undefined) e.textContent = text; return e; };
  const seconds = (s) => (s < 10 ? s.toFixed(1) + " s" : s < 100 ? s.toFixed(0) + " s" : s < 5400 ? (s / 60).toFixed(1) + " min" : (s / 3600).toFixed(1) + " h");
  const percent = (v) => (100 * v).toFixed(v > 0.995 || v < 0.005 ? 0 : v < 0.1 ? 1 : 0) + " %";

  /* ---------------------------------------------------------------- the model */
  const viewer = window.banmoViewer = BanmoViewer.start(data);
  const play = $("play"), time = $("time"), clock = $("clock"), clip = $("clip"), legend = $("legend");
  function showTime() { time.max = viewer.duration || 1; time.value = viewer.time; clock.textContent = `${viewer.time.toFixed(2)} of ${viewer.duration.toFixed(2)} s`; }
  function setPlaying(on) { viewer.playing = on; play.textContent = on ? "Pause" : "Play"; play.setAttribute("aria-pressed", String(on)); }
  function showLegend() {
    legend.replaceChildren(); legend.hidden = viewer.look !== "seen";
    if (legend.hidden) return;
    const bar = make("div", "ramp"); bar.style.background = `linear-gradient(90deg, ${[0, 0.25, 0.5, 0.75, 1].map((t) => `rgb(${BanmoViewer.ramp(t).map((v) => Math.round(255 * v)).join(" ")})`).join(", ")})`;
    const ends = make("div", "ends"); ends.append(make("span", "", "seldom seen"), make("span", "", `in ${Math.round(100 * viewer.mostSeen)} % of the frames`));
    const never = make("div"), swatch = make("i", "swatch"); swatch.style.background = "rgb(219 56 71)"; never.append(swatch, "never seen: made up");
    legend.append(bar, ends, never);
  }
  viewer.on && viewer.on((what) => {
    if (what === "time") return showTime();
    clip.replaceChildren(...viewer.names.map((n) => { const o = make("option", "", n); o.value = n; return o; }));
    clip.disabled = viewer.names.length < 2;
    const seen = document.querySelector('[data-look="seen"]'); seen.disabled = !viewer.hasSeen; if (!viewer.hasSeen) seen.title = "the model file does not say what was seen";
    showTime();
  });
  play.onclick = () => setPlaying(!viewer.playing);
  clip.onchange = () => { viewer.choose(clip.value); showTime(); };
  time.oninput = () => { setPlaying(false); viewer.seek(Number(time.value)); showTime(); };
  $("speed").onchange = (e) => { viewer.speed = Number(e.target.value); };
  $("bones").onchange = (e) => viewer.setBones(e.target.checked);
  $("wire").onchange = (e) => viewer.setWire(e.target.checked);
  $("turn").onchange = (e) => viewer.setTurn(e.target.checked);
  $("filmed").onchange = (e) => { viewer.setFilmed(e.target.checked); showTime(); };
  for (const b of $("colours").querySelectorAll("button")) b.onclick = () => {
    viewer.setLook(b.dataset.look);
    for (const o of $("colours").querySelectorAll("button")) o.setAttribute("aria-pressed", String(o.dataset.look === viewer.look));
    showLegend();
  };
  $("view").onkeydown = (e) => { if (e.key === " ") { e.preventDefault(); setPlaying(!viewer.playing); } };

  /* ---------------------------------------------------------------- views */
  $("compass").append(BanmoCharts.compass(data.clips));
  for (const [name, share] of data.sides) {
    const row = make("div", "side"), meter = make("div", "meter"), fill = make("i"); fill.style.width = `${100 * share}%`; meter.append(fill);
    row.append(make("span", "", name), meter, make("span", "n", percent(share))); $("sides").append(row);
  }

  /* ---------------------------------------------------------------- clips */
  for (const c of data.clips) {
    const card = make("article", "card clip-card"), head = make("div", "clip-head");
    head.append(make("h3", "", c.name), make("span", "", c.about)); card.append(head);
    const source = provenance && provenance.videos && provenance.videos[c.name];
    if (source && source.file && source.file !== c.name) head.append(make("span", "", `from ${source.file}`));
    const chart = BanmoCharts.line(c.agreement, { width: 1000, height: 92, low: 0, high: 1, percent: true, label: `agreement of outlines in ${c.name}` });
    if (c.video) {
      const video = make("video"); video.src = c.video; video.muted = true; video.loop = true; video.playsInline = true; video.preload = "auto";
      const panels = make("div", "panels"); panels.append(make("span", "", "filmed"), make("span", "", "model over it"), make("span", "", "bones"));
      const row = make("div", "scrub"), button = make("button", "", "Play"), range = make("input", "grow"), at = make("output", "clock", "0.00 s");
      range.type = "range"; range.min = 0; range.max = c.seconds || 1; range.step = "any"; range.value = 0; range.setAttribute("aria-label", `time in ${c.name}`);
      const show = () => { range.value = video.currentTime; at.textContent = `${video.currentTime.toFixed(2)} s`; chart.cursor(video.currentTime); };
      button.onclick = () => { if (video.paused) video.play(); else video.pause(); };
      video.onplay = () => { button.textContent = "Pause"; tick(); }; video.onpause = () => { button.textContent = "Play"; };
      video.ontimeupdate = video.onseeked = show; video.onloadedmetadata = () => { range.max = video.duration; };
      const tick = () => { if (!video.paused) { show(); requestAnimationFrame(tick); } };
      const go = (t) => { video.pause(); video.currentTime = t; };
      range.oninput = () => go(Number(range.value));
      chart.root.style.cursor = "pointer"; chart.root.onclick = (e) => chart.at && go(chart.at(e));
      row.append(button, range, at); card.append(video, panels, row);
    }
    card.append(chart.root);
    const strips = make("div", "strips");
    for (const s of c.strips) {
      const row = make("div", "strip"), image = make("img"); image.src = s.picture; image.alt = s.about; image.title = s.about; image.loading = "lazy"; row.append(make("span", "", s.name), image); strips.append(row);
    }
    card.append(strips); $("clip-cards").append(card);
  }

  /* ---------------------------------------------------------------- curves */
  for (const c of data.curves) {
    const box = make("div", "chart"); box.append(make("h3", "", c.name));
    box.append(BanmoCharts.line(c.points, { logarithmic: true, start: 0, end: data.steps, marks: data.phases, label: c.name }).root); $("loss-charts").append(box);
  }
  if (!data.curves.length) $("curves").hidden = true;

  /* ---------------------------------------------------------------- plan */
  const ran = provenance && Array.isArray(provenance.ran) ? provenance.ran : [];
  if (ran.length) {
    const stages = new Map();
    for (const r of ran) { const s = stages.get(r.stage) || { seconds: 0, count: 0, reasons: new Set(), when: "" }; s.seconds += r.seconds; s.count++; if (r.reason) s.reasons.add(r.reason); if (r.when > s.when) s.when = r.when; stages.set(r.stage, s); }
    const order = (n) => { const i = data.stages.indexOf(n); return i < 0 ? 99 : i; };
    const sorted = [...stages].sort((a, b) => order(a[0]) - order(b[0]));
    const most = Math.max(...[...stages.values()].map((s) => s.seconds), 1e-9), total = [...stages.values()].reduce((a, s) => a + s.seconds, 0);
    const table = make("table", "plan"), head = make("tr"), body = make("tbody");
    for (const [t, n] of [["Stage", 0], ["Time", 1], ["", 0], ["Results", 1], ["Why it ran", 0], ["When (UTC)", 0]]) head.append(make("th", n ? "n" : "", t));
    for (const [name, s] of sorted) {
      const row = make("tr"), meter = make("div", "meter"), fill = make("i"), cell = make("td"); fill.style.width = `${100 * s.seconds / most}%`; meter.append(fill); cell.append(meter);
      const reasons = [...s.reasons]; const why = reasons.slice(0, 3).join("; ") + (reasons.length > 3 ? ` and ${reasons.length - 3} more` : "");
      row.append(make("td", "", name), make("td", "n", seconds(s.seconds)), cell, make("td", "n", String(s.count)), make("td", "", why), make("td", "", s.when.replace("T", " ").slice(0, 16))); body.append(row);
    }
    const thead = make("thead"); thead.append(head); table.append(thead, body);
    $("plan").replaceChildren(make("p", "about", `${ran.length} results, ${seconds(total)} of work in all; what was up to date was not done again.`), table);
  }
  const stagesOf = (results) => [...new Set(results.map((r) => r.split("/")[0]))].join(", ");
  const licensed = provenance ? [
    ...Object.entries(provenance.networks || {}).map(([name, n]) => [name, n.summary, n.licence, n.source, stagesOf(n.used_by || [])]),
    ...Object.entries(provenance.files_of_settings || {}).filter(([, f]) => f.about && f.about.licence).map(([name, f]) => [name, f.about.summary || "", f.about.licence, f.about.source || f.about.url || "", name.split(".")[0]]),
  ] : [];
  if (licensed.length) {
    const table = make("table"), head = make("tr");
    for (const t of ["File", "What it is", "Licence", "Source", "Used by"]) head.append(make("th", "", t));
    table.append(head);
    for (const cells of licensed) { const row = make("tr"); for (const c of cells) row.append(make("td", "whole", String(c || ""))); table.append(row); }
    $("networks-table").append(table); $("networks").hidden = false;
  }
  if (provenance && provenance.settings) {
    for (const [section, values] of Object.entries(provenance.settings)) {
      const box = make("details"), table = make("table"); box.append(make("summary", "", section));
      for (const [k, v] of Object.entries(values)) { const row = make("tr"); row.append(make("td", "", k), make("td", "", typeof v === "string" ? v : JSON.stringify(v))); table.append(row); }
      box.append(table); $("settings-tables").append(box);
    }
    $("settings").hidden = false;
  }
})();
