(() => {
  "use strict";
  const nonce = document.currentScript.nonce;
  const one = (selector, from = document) => from.querySelector(selector);
  const all = (selector, from = document) => [...from.querySelectorAll(selector)];
  const data = JSON.parse(one("#data").textContent);
  let axis = "x";
  const { rangeOf, short } = RejeuCharts;
  const chosen = {}; // the bar of each histogram whose episodes are listed
  const visible = (element) => element.offsetParent !== null;

  async function loadPlotly() {
    const bytes = Uint8Array.from(atob(one("#plotly").textContent), (letter) => letter.charCodeAt(0));
    const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const script = document.createElement("script");
    script.nonce = nonce;
    script.textContent = await new Response(unpacked).text();
    document.head.append(script);
  }

  function drawChart(element) {
    const chart = data.charts[element.dataset.chart];
    if (chart) RejeuCharts.draw(element, chart, axis, one(".legend", element.parentElement));
  }

  function drawHistogram(element) {
    const key = element.dataset.histogram;
    const h = data.histograms[key];
    if (!h) return;
    RejeuCharts.histogram(element, h, chosen[key], (bar) => list(element, bar));
    const select = one(`[data-bars="${key}"]`);
    const options = h.counts.map((n, i) => new Option(`${rangeOf(h, i)} (${n.toLocaleString("en-US")})`, i));
    select.replaceChildren(new Option("choose", ""), ...options.filter((_, i) => h.counts[i]));
    select.value = chosen[key] ?? "";
    select.onchange = () => list(element, select.value === "" ? undefined : Number(select.value));
  }

  function list(element, bar) {
    const key = element.dataset.histogram;
    const h = data.histograms[key];
    const box = one(`[data-list="${key}"]`);
    chosen[key] = bar;
    drawHistogram(element);
    box.replaceChildren();
    if (bar === undefined || !h.counts[bar]) return;
    const rows = h.rows[bar];
    const kept = h.columns.map((_, i) => i).filter((i) => rows.some((row) => row[i] != null));
    const table = document.createElement("table");
    const add = (part, tag, cells) => {
      const row = part.insertRow();
      for (const cell of cells) {
        const made = document.createElement(tag);
        made.append(cell);
        row.append(made);
      }
    };
    const seed = h.command ? h.columns.indexOf("seed") : -1;
    const more = (row) => (seed < 0 ? [] : [h.command.replace("--seed N", `--seed ${row[seed]}`)]);
    add(table.createTHead(), "th", [...kept.map((i) => h.columns[i]), ...(seed < 0 ? [] : ["command"])]);
    const body = table.createTBody();
    const cell = (name, value) => (name === "success" && value != null ? (value ? "yes" : "no") : short(value));
    for (const row of rows) add(body, "td", [...kept.map((i) => cell(h.columns[i], row[i])), ...more(row)]);
    const note = document.createElement("p");
    const total = h.counts[bar].toLocaleString("en-US");
    note.className = "note";
    note.append(rows.length < h.counts[bar] ? `${rows.length} of ${total} episodes with a return of ${rangeOf(h, bar)}, evenly spaced in time.`
      : `${total} ${rows.length === 1 ? "episode" : "episodes"} with a return of ${rangeOf(h, bar)}.`);
    const scroll = document.createElement("div");
    scroll.className = "scroll";
    scroll.append(table);
    box.append(note, scroll);
  }

  // One after the other, so that the first charts are there before the last are drawn.
  let drawing = 0;
  async function draw() {
    const turn = ++drawing;
    for (const element of all("[data-chart], [data-histogram]").filter(visible)) {
      if (turn !== drawing) return;
      if (element.dataset.chart) drawChart(element);
      else drawHistogram(element);
      document.body.dataset.drawn = "some";
      await new Promise((resolve) => setTimeout(resolve));
    }
    document.body.dataset.drawn = "all";
  }

  function show(run) {
    for (const main of all(".run")) main.hidden = main.id !== run;
    if (one("#choose")) one("#choose").value = run;
    draw();
  }

  for (const button of all("[data-axis]")) {
    button.addEventListener("click", () => {
      axis = button.dataset.axis;
      for (const other of all("[data-axis]")) other.setAttribute("aria-pressed", String(other === button));
      draw();
    });
  }
  one("#choose")?.addEventListener("change", (event) => show(event.target.value));
  for (const link of all("[data-run]")) link.addEventListener("click", () => show(link.dataset.run));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);

  loadPlotly().then(() => {
    const runs = all(".run");
    if (runs.length > 1) show(runs.some((run) => `#${run.id}` === location.hash) ? location.hash.slice(1) : runs[0].id);
    else draw();
  }, (error) => {
    console.error(error);
    for (const element of all(".plot")) element.textContent = "The charts need a browser of 2023 or later.";
  });
})();
