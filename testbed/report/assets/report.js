"use strict";
(() => {
  const root = document.documentElement;
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const one = (selector, within = document) => within.querySelector(selector);
  const prefersDark = matchMedia("(prefers-color-scheme: dark)");
  let stored = null;
  try { stored = localStorage.getItem("testbed-theme"); } catch { /* no storage for this page */ }

  // theme ------------------------------------------------------------------------------------------------------------
  const button = one("#theme");
  function setTheme(name) {
    root.dataset.theme = name;
    button.textContent = name === "dark" ? "Light" : "Dark";
    button.setAttribute("aria-pressed", String(name === "dark"));
    button.setAttribute("aria-label", `Switch to ${name === "dark" ? "light" : "dark"} colours`);
  }
  setTheme(stored || (prefersDark.matches ? "dark" : "light"));
  button.addEventListener("click", () => {
    const name = root.dataset.theme === "dark" ? "light" : "dark";
    try { localStorage.setItem("testbed-theme", name); } catch { /* the choice lasts as long as the page */ }
    setTheme(name);
    restyle();
  });
  prefersDark.addEventListener("change", (event) => {
    if (stored) return;
    setTheme(event.matches ? "dark" : "light");
    restyle();
  });

  // tables -----------------------------------------------------------------------------------------------------------
  const key = (row, column) => {
    const cell = row.cells[column];
    if (cell.tagName === "TH") return cell.textContent.trim();
    return cell.dataset.value === undefined ? NaN : Number(cell.dataset.value);
  };
  function sort(table, column, direction) {
    const rows = all("tbody tr", table);
    const order = (a, b) => {
      const [x, y] = [key(a, column), key(b, column)];
      if (typeof x === "string") return direction * x.localeCompare(y, undefined, { numeric: true });
      if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
      return direction * (x - y);
    };
    one("tbody", table).append(...rows.sort(order));
    const heads = all("thead tr:last-child th", table);
    heads.forEach((head, k) => head.setAttribute("aria-sort", k !== column ? "none" : direction > 0 ? "ascending" : "descending"));
  }
  for (const table of all("table.sortable")) {
    all("thead tr:last-child th", table).forEach((head, column) => {
      const press = document.createElement("button");
      press.type = "button";
      press.append(...head.childNodes);
      head.append(press);
      press.addEventListener("click", () => sort(table, column, head.getAttribute("aria-sort") === "ascending" ? -1 : 1));
    });
  }
  const chosen = one("#window");
  if (chosen) chosen.addEventListener("change", () => all(".window").forEach((w, k) => { w.hidden = k !== Number(chosen.value); }));
  one("#intervals").addEventListener("change", (event) => one("#comparison").classList.toggle("intervals", event.target.checked));

  // intervals: on hover, and with the arrow keys from cell to cell
  const tip = one("#tip");
  function showTip(cell) {
    tip.textContent = (/^(bounds)/.test(cell.dataset.interval) ? "95 % " : "95 % interval ") + cell.dataset.interval;
    tip.hidden = false;
    const at = cell.getBoundingClientRect();
    tip.style.left = `${Math.max(4, Math.min(at.right - tip.offsetWidth, innerWidth - tip.offsetWidth - 4))}px`;
    tip.style.top = `${at.top > tip.offsetHeight + 8 ? at.top - tip.offsetHeight - 4 : at.bottom + 4}px`;
    cell.setAttribute("aria-describedby", "tip");
  }
  function hideTip(event) {
    tip.hidden = true;
    event?.target.removeAttribute?.("aria-describedby");
  }
  for (const table of all("table")) {
    const cells = all("td[data-interval]", table);
    cells.forEach((cell, k) => { cell.tabIndex = k ? -1 : 0; });
    table.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
      const cell = event.target.closest("td");
      if (!step || !cell) return;
      let [row, column] = [cell.parentElement.sectionRowIndex, cell.cellIndex];
      const body = cell.parentElement.parentElement;
      for (;;) {
        row += step[0];
        column += step[1];
        const next = body.rows[row]?.cells[column];
        if (!next) return;
        if (next.dataset.interval === undefined) continue;
        cells.forEach((c) => { c.tabIndex = c === next ? 0 : -1; });
        next.focus();
        event.preventDefault();
        return;
      }
    });
  }
  for (const cell of all("td[data-interval]")) {
    cell.addEventListener("mouseenter", () => showTip(cell));
    cell.addEventListener("mouseleave", hideTip);
    cell.addEventListener("focus", () => showTip(cell));
    cell.addEventListener("blur", hideTip);
  }
  addEventListener("scroll", hideTip, { passive: true });
  addEventListener("keydown", (event) => { if (event.key === "Escape") hideTip(); });

  // plots ------------------------------------------------------------------------------------------------------------
  const figures = all(".chart");
  let data = null;
  let ready = null;
  let printing = false;
  const PAPER_WIDTH = 660;
  const dark = () => !printing && root.dataset.theme === "dark";
  const hidden = () => new Set(all('[name="estimator"]').filter((box) => !box.checked).map((box) => box.value));

  async function unpack(id) {
    const packed = Uint8Array.from(atob(one(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }
  function load() {
    ready ??= (async () => {
      const [library, traces] = await Promise.all([unpack("#plotly"), unpack("#data")]);
      data = JSON.parse(traces);
      const script = document.createElement("script");
      script.textContent = library;
      document.head.append(script);
      one("#plotly").textContent = one("#data").textContent = "";
      return window.Plotly;
    })();
    return ready;
  }

  const palette = () => dark()
    ? { ink: "#e6e5e1", soft: "#a3a5a9", grid: "#303236", outage: "#55585e", shade: "rgba(255,255,255,0.13)", stripe: "rgba(255,255,255,0.035)", paper: "#17181a" }
    : { ink: "#1c1d1f", soft: "#5d6066", grid: "#e6e6e1", outage: "#c4c4be", shade: "rgba(0,0,0,0.11)", stripe: "rgba(0,0,0,0.03)", paper: printing ? "#ffffff" : "#fdfdfb" };
  const shade = (hex, alpha) => `rgba(${[1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)).join(",")},${alpha})`;

  function colour(meta, tones) {
    if (meta.colour === "outage") return tones.outage;
    if (meta.colour === -1) return tones.ink;
    return data.colours[meta.colour % data.colours.length][dark() ? 1 : 0];
  }
  function dressTrace(trace, tones, off, band) {
    const { meta } = trace;
    const tone = colour(meta, tones);
    const out = { ...trace, line: { ...trace.line, color: tone } };
    if (trace.marker) out.marker = { ...trace.marker, color: tone };
    if (trace.fill) out.fillcolor = meta.colour === "outage" ? shade(tone, 0.55) : shade(tone, meta.fill ?? 0.2);
    if (meta.edge) out.line.color = "rgba(0,0,0,0)";
    out.visible = !(off.has(meta.estimator) || (meta.band && meta.band !== band));
    out.showlegend = meta.shown === true || (meta.colour === -1 && meta.shown !== false);
    if (meta.colour === -1 && trace.mode === "markers") out.showlegend = false;
    return out;
  }
  function dressAxis(axis, tones) {
    return { gridcolor: tones.grid, zerolinecolor: tones.grid, linecolor: tones.soft, tickcolor: tones.soft, ticks: "outside", ticklen: 4,
      showline: true, automargin: true, ...axis };
  }
  function dress(figure) {
    const chart = data.charts[figure.dataset.key];
    const view = chart.views[one('[type="radio"]:checked', figure)?.value ?? Object.keys(chart.views)[0]];
    const band = one("select", figure)?.value;
    const [tones, off] = [palette(), hidden()];
    const layout = structuredClone(view.layout);
    Object.assign(layout, {
      autosize: true, paper_bgcolor: tones.paper, plot_bgcolor: tones.paper, showlegend: Boolean(layout.showlegend),
      font: { family: getComputedStyle(root).getPropertyValue("--sans"), size: 12, color: tones.ink },
      margin: layout.margin ?? { l: 62, r: 12, t: 46, b: 46 },
      legend: { orientation: "h", x: 0, xanchor: "left", y: 1.02, yanchor: "bottom", bgcolor: "rgba(0,0,0,0)" },
      hoverlabel: { bgcolor: tones.paper, bordercolor: tones.soft, font: { color: tones.ink } },
      uirevision: figure.dataset.view = one('[type="radio"]:checked', figure)?.value ?? "",
    });
    for (const name of Object.keys(layout)) if (/^[xy]axis\d*$/.test(name)) layout[name] = dressAxis(layout[name], tones);
    if (figure.dataset.key === "track") {
      const [[x0, x1], [y0, y1]] = [layout.xaxis.range, layout.yaxis.range];
      const width = (printing ? PAPER_WIDTH : one(".plot", figure).clientWidth) - 80;
      layout.height = Math.round(Math.max(260, Math.min(560, (width * (y1 - y0)) / (x1 - x0) + 95)));
      one(".plot", figure).style.minHeight = `${layout.height}px`;
    }
    if (layout.scene) {
      for (const name of ["xaxis", "yaxis", "zaxis"]) {
        Object.assign(layout.scene[name], { gridcolor: tones.grid, zerolinecolor: tones.grid, linecolor: tones.soft, showbackground: false, color: tones.ink });
      }
    }
    for (const shape of layout.shapes ?? []) {
      if (shape.type === "line") shape.line.color = tones.ink;
      else shape.fillcolor = shape.name === "outage" ? tones.shade : tones.stripe;
    }
    for (const note of layout.annotations ?? []) note.font = { size: 10, color: tones.soft };
    return [view.data.map((trace) => dressTrace(trace, tones, off, band)), layout];
  }
  const flat = [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
  const space = [["toImage", "orbitRotation", "pan3d", "resetCameraDefault3d"]];
  const config = (figure) => ({ responsive: true, displaylogo: false, scrollZoom: ["track", "path"].includes(figure.dataset.key),
    modeBarButtons: figure.dataset.key === "path" ? space : flat });
  function draw(figure) {
    const [traces, layout] = dress(figure);
    const done = window.Plotly.react(one(".plot", figure), traces, layout, config(figure));
    figure.dataset.drawn = "yes";
    return done;
  }
  function colourKeys() {
    all("[data-colour]").forEach((key) => { key.style.borderColor = colour({ colour: Number(key.dataset.colour) }, {}); });
  }
  function restyle() {
    if (data) colourKeys();
    if (window.Plotly) figures.filter((f) => f.dataset.drawn).forEach(draw);
  }
  function fail(figure, error) {
    one(".plot", figure).textContent = `This plot could not be drawn (${error.message}). The folder “figures” holds it as a picture.`;
    one(".plot", figure).style.minHeight = "0";
  }
  const queue = [];
  let working = false;
  async function work() {
    if (working) return;
    working = true;
    await load();
    restyle();
    while (queue.length) {
      const figure = queue.shift();
      if (figure.dataset.drawn) continue;
      try { await draw(figure); } catch (error) { fail(figure, error); console.error(error); }
      await new Promise((resume) => setTimeout(resume));
    }
    working = false;
    root.dataset.plots = figures.every((f) => f.dataset.drawn) ? "drawn" : "waiting";
  }
  if (figures.length) {
    const seen = new IntersectionObserver((entries) => {
      const near = entries.filter((entry) => entry.isIntersecting).map((entry) => entry.target);
      near.forEach((figure) => seen.unobserve(figure));
      queue.unshift(...near);
      if (queue.length) work();
    }, { rootMargin: "400px" });
    figures.forEach((figure) => seen.observe(figure));
    // the rest is drawn when the page is at rest, so that printing finds every plot
    addEventListener("load", () => setTimeout(() => { queue.push(...figures); work(); }, 600));
  }
  for (const box of all('[name="estimator"]')) box.addEventListener("change", restyle);
  for (const figure of figures) figure.addEventListener("change", () => { if (window.Plotly && data) draw(figure); });

  // keys on a plot: + and − zoom in time, arrows move, 0 shows everything
  for (const figure of figures) {
    one(".plot", figure).addEventListener("keydown", (event) => {
      const plot = one(".plot", figure);
      const axis = plot._fullLayout?.xaxis;
      if (!axis || event.ctrlKey || event.metaKey || event.altKey) return;
      const [a, b] = axis.range;
      const half = (b - a) / 2;
      const moves = { "+": [a + half / 2, b - half / 2], "-": [a - half, b + half], ArrowLeft: [a - half / 2, b - half / 2], ArrowRight: [a + half / 2, b + half / 2] };
      if (event.key === "0") window.Plotly.relayout(plot, { "xaxis.autorange": true, "yaxis.autorange": true });
      else if (moves[event.key]) window.Plotly.relayout(plot, { "xaxis.range": moves[event.key] });
      else return;
      event.preventDefault();
    });
  }

  // print: ink on white, at the width of the paper
  addEventListener("beforeprint", () => {
    printing = true;
    if (!window.Plotly) return;
    colourKeys();
    for (const figure of figures.filter((f) => f.dataset.drawn)) {
      const [traces, layout] = dress(figure);
      const size = { autosize: false, width: PAPER_WIDTH, height: Math.round(0.8 * layout.height) };
      window.Plotly.react(one(".plot", figure), traces, { ...layout, ...size, font: { ...layout.font, size: 10 } }, config(figure));
    }
  });
  addEventListener("afterprint", () => { printing = false; restyle(); });
})();
