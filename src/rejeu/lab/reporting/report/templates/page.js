(() => {
  "use strict";
  const nonce = document.currentScript.nonce;
  const one = (selector, from = document) => from.querySelector(selector);
  const all = (selector, from = document) => [...from.querySelectorAll(selector)];
  let data = JSON.parse(one("#data").textContent);
  let axis = "x";
  const hidden = new Set(); // series that the reader switched off, as "chart/number"
  const chosen = {}; // the bar of each histogram whose episodes are listed
  const bare = { displayModeBar: false, responsive: true, scrollZoom: false };

  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const faded = (name, share) => {
    const value = parseInt(color(name).slice(1), 16);
    return `rgba(${value >> 16},${(value >> 8) & 255},${value & 255},${share})`;
  };
  // Plotly shows a few HTML tags in its labels; here all text is plain.
  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;");
  const visible = (element) => element.offsetParent !== null;

  async function loadPlotly() {
    const bytes = Uint8Array.from(atob(one("#plotly").textContent), (letter) => letter.charCodeAt(0));
    const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const script = document.createElement("script");
    script.nonce = nonce;
    script.textContent = await new Response(unpacked).text();
    document.head.append(script);
  }

  function layout(chart, more = {}) {
    const phone = matchMedia("(pointer: coarse)").matches;
    const line = { gridcolor: color("rule"), zeroline: false, linecolor: color("rule"), automargin: true };
    const title = (text) => ({ text: plain(text), font: { size: 12, color: color("muted") }, standoff: 6 });
    return {
      margin: { l: 8, r: 14, t: 6, b: 8 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: false,
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: color("muted") },
      hoverlabel: { bgcolor: color("card"), bordercolor: color("rule"), font: { color: color("ink") }, namelength: -1 },
      hovermode: "closest", dragmode: phone ? false : "zoom",
      xaxis: {
        ...line, showgrid: false, tickformat: "~s", title: title(more.x ?? ""), range: more.range, nticks: 8,
      },
      yaxis: {
        ...line, title: title(chart.y ?? ""), range: chart.range ?? undefined, nticks: 7, exponentformat: "power",
        tickformat: chart.percent ? ".0%" : "", separatethousands: true,
      },
      ...more.layout,
    };
  }

  function traces(chart, key) {
    const found = [];
    chart.series.forEach((series, number) => {
      const x = series[axis];
      const value = chart.percent ? "%{y:.1%}" : "%{y:,.5~g}";
      const common = {
        x, name: plain(series.name), visible: !hidden.has(`${key}/${number}`), type: "scatter",
        hovertemplate: `${value}${series.name ? ` ${plain(series.name)}` : ""}<br>${chart.x ? `${plain(chart.x)} %{x:,.4~g}` : axis === "x" ? "step %{x:,d}" : "%{x:,.4~g} min"}<extra></extra>`,
      };
      const own = color(series.color);
      if (series.kind === "dots") {
        const size = Math.min(5.5, Math.max(3, 60 / Math.sqrt(x.length)));
        const opacity = Math.min(0.65, Math.max(0.3, 400 / x.length));
        found.push({ ...common, y: series.y, mode: "markers", marker: { color: own, size, opacity } });
      } else if (series.kind === "line") {
        found.push({ ...common, y: series.y, mode: "lines", line: { color: own, width: 2 } });
      } else if (series.kind === "points") {
        const reach = (end, sign) => series.y.map((y, i) => (end?.[i] == null ? 0 : sign * (end[i] - y)));
        const bars = { type: "data", symmetric: false, array: reach(series.high, 1), arrayminus: reach(series.low, -1) };
        found.push({
          ...common, y: series.y, mode: "markers", cliponaxis: false,
          marker: { color: own, size: 8, line: { color: color("card"), width: 1.5 } },
          error_y: { ...bars, color: own, thickness: 1.3, width: 0, visible: Boolean(series.low) },
        });
      } else if (series.kind === "band") {
        const keep = x.map((_, i) => i).filter((i) => series.low[i] != null && series.high[i] != null);
        const edge = { ...common, x: keep.map((i) => x[i]), mode: "lines", line: { width: 0 }, hoverinfo: "skip", hovertemplate: undefined };
        found.push({ ...edge, y: keep.map((i) => series.low[i]) });
        found.push({ ...edge, y: keep.map((i) => series.high[i]), fill: "tonexty", fillcolor: faded(series.color, 0.2) });
      } else if (series.kind === "area") {
        found.push({ ...common, y: series.y, mode: "lines", line: { width: 0.5, color: own }, fillcolor: own, stackgroup: "all" });
      }
    });
    return found;
  }

  function drawChart(element) {
    const key = element.dataset.chart;
    const chart = data.charts[key];
    if (!chart) return;
    const stacked = chart.series.some((series) => series.kind === "area");
    const more = { layout: stacked ? { hovermode: "x unified" } : {} };
    if (!chart.small) more.x = chart.x ?? (axis === "x" ? "environment steps" : "minutes of training");
    const last = Math.max(0, ...chart.series.map((series) => series[axis].findLast((x) => x != null) ?? 0));
    more.range = chart.x_range ?? (last > 0 ? [0, last * (stacked ? 1 : 1.02)] : undefined);
    Plotly.react(element, traces(chart, key), layout(chart, more), bare);
    legend(element, chart, key);
  }

  function legend(element, chart, key) {
    const box = one(".legend", element.parentElement);
    if (!box) return;
    const focused = [...box.children].indexOf(document.activeElement);
    box.replaceChildren();
    chart.series.forEach((series, number) => {
      if (!series.name) return;
      const button = document.createElement("button");
      const sign = document.createElement("i");
      button.type = "button";
      button.setAttribute("aria-pressed", String(!hidden.has(`${key}/${number}`)));
      sign.className = series.kind;
      sign.style.background = series.kind === "band" ? faded(series.color, 0.35) : color(series.color);
      button.append(sign, series.name);
      button.addEventListener("click", () => {
        const name = `${key}/${number}`;
        if (!hidden.delete(name)) hidden.add(name);
        drawChart(element);
      });
      box.append(button);
    });
    box.children[focused]?.focus(); // of the keyboard, which was on the button before
  }

  const digits = (value) => (Number.isInteger(value) ? {} : { maximumSignificantDigits: 6 });
  const short = (value) => (value == null ? "–" : value.toLocaleString("en-US", digits(value)).replace("-", "−"));
  const rangeOf = (h, i) => `${short(i === 0 ? h.least : h.edges[i])} to ${short(i === h.counts.length - 1 ? h.most : h.edges[i + 1])}`;

  function drawHistogram(element) {
    const key = element.dataset.histogram;
    const h = data.histograms[key];
    if (!h) return;
    const middles = h.counts.map((_, i) => (h.edges[i] + h.edges[i + 1]) / 2);
    const colors = h.counts.map((_, i) => (i === chosen[key] ? color("accent") : color("dots")));
    const text = h.counts.map((n, i) => `${n.toLocaleString("en-US")} episodes<br>${rangeOf(h, i)}`);
    const bars = {
      type: "bar", x: middles, y: h.counts, width: h.edges[1] - h.edges[0], hovertext: text, hovertemplate: "%{hovertext}<extra></extra>",
      marker: { color: colors, line: { color: color("card"), width: 1 } },
    };
    const axes = layout({ y: "episodes" }, { x: "return", layout: { dragmode: false, bargap: 0 } });
    Object.assign(axes.yaxis, { rangemode: "tozero", exponentformat: "none" });
    Plotly.react(element, [bars], axes, bare);
    const select = one(`[data-bars="${key}"]`);
    const options = h.counts.map((n, i) => new Option(`${rangeOf(h, i)} (${n.toLocaleString("en-US")})`, i));
    select.replaceChildren(new Option("choose", ""), ...options.filter((_, i) => h.counts[i]));
    select.value = chosen[key] ?? "";
    if (!element.dataset.ready) {
      element.dataset.ready = "yes";
      element.on("plotly_click", (event) => list(element, event.points[0].pointNumber));
      select.addEventListener("change", () => list(element, select.value === "" ? undefined : Number(select.value)));
    }
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

  async function follow() {
    const answer = await fetch(`data.json?version=${encodeURIComponent(data.version)}`, { cache: "no-store" });
    if (answer.status === 204) return;
    const news = await answer.json();
    const names = (charts) => Object.keys(charts).sort().join(" ");
    if (names(news.charts) !== names(data.charts) || names(news.histograms) !== names(data.histograms)) {
      location.reload();
      return;
    }
    data = news;
    for (const element of all("[data-part]")) {
      if (!(element.dataset.part in news.parts)) continue;
      const top = one(".tall", element)?.scrollTop;
      element.innerHTML = news.parts[element.dataset.part]; // escaped by the server
      if (top) one(".tall", element).scrollTop = top;
    }
    draw();
  }

  async function poll() {
    try {
      await follow();
      document.body.dataset.live = "";
    } catch {
      document.body.dataset.live = "ended";
    }
    setTimeout(poll, 2000);
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
    if ("live" in document.body.dataset) poll();
  }, (error) => {
    console.error(error);
    for (const element of all(".plot")) element.textContent = "The charts need a browser of 2023 or later.";
  });
})();
