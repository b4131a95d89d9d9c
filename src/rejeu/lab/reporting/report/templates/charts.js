// Draws the charts and histograms of rejeu.logs.charts with Plotly: in pages that are one file, and in the studio.
const RejeuCharts = (() => {
  "use strict";
  const bare = { displayModeBar: false, responsive: true, scrollZoom: false };

  const color = (name) => getComputedStyle(document.body).getPropertyValue(`--${name}`).trim();
  const faded = (name, share) => {
    const value = parseInt(color(name).slice(1), 16);
    return `rgba(${value >> 16},${(value >> 8) & 255},${value & 255},${share})`;
  };
  // Plotly shows a few HTML tags in its labels; here all text is plain.
  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;");
  const named = (chart, text) => chart.names?.[text] ?? text; // in the language of a page of the studio
  const switchedOff = new WeakMap(); // the numbers of the series that the reader switched off, by plot
  const drawn = new WeakMap(); // the chart that was drawn last, by plot

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
        ...line, showgrid: false, tickformat: more.range?.every((end) => Math.abs(end) < 10) ? "" : "~s", title: title(more.x ?? ""), range: more.range, nticks: 8,
      },
      yaxis: {
        ...line, title: title(chart.y ?? ""), range: chart.range ?? undefined, nticks: 7, exponentformat: "power",
        tickformat: chart.percent ? ".0%" : "", separatethousands: true,
      },
      ...more.layout,
    };
  }

  function traces(chart, axis, hidden) {
    const found = [];
    chart.series.forEach((series, number) => {
      const x = series[axis];
      const value = chart.percent ? "%{y:.1%}" : "%{y:,.5~g}";
      const common = {
        x, name: plain(series.name), visible: !hidden.has(number), type: "scatter", showlegend: Boolean(series.name) && series.kind !== "thin",
        hovertemplate: `${value}${series.name ? ` ${plain(series.name)}` : ""}<br>${chart.x ? `${plain(chart.x)} %{x:,.4~g}` : axis === "x" ? "step %{x:,d}" : "%{x:,.4~g} min"}<extra></extra>`,
      };
      const own = color(series.color);
      if (series.kind === "dots") {
        const size = Math.min(5.5, Math.max(3, 60 / Math.sqrt(x.length)));
        const opacity = Math.min(0.65, Math.max(0.3, 400 / x.length));
        found.push({ ...common, y: series.y, mode: "markers", marker: { color: own, size, opacity } });
      } else if (series.kind === "line") {
        found.push({ ...common, y: series.y, mode: "lines", line: { color: own, width: 2 } });
      } else if (series.kind === "thin") {
        found.push({ ...common, y: series.y, mode: "lines", line: { color: faded(series.color, 0.4), width: 1 } });
      } else if (series.kind === "points") {
        const reach = (end, sign) => series.y.map((y, i) => (end?.[i] == null ? 0 : sign * (end[i] - y)));
        const bars = { type: "data", symmetric: false, array: reach(series.high, 1), arrayminus: reach(series.low, -1) };
        found.push({
          ...common, y: series.y, mode: "markers", cliponaxis: false,
          marker: { color: own, size: 8, line: { color: color("card"), width: 1.5 } },
          error_y: { ...bars, color: own, thickness: 1.3, width: 0, visible: Boolean(series.low) },
        });
      } else if (series.kind === "places") {
        found.push({
          ...common, y: series.y, mode: "markers", customdata: series.places, text: series.text.map(plain), hovertemplate: "%{text}<extra></extra>",
          marker: { color: own, size: Math.min(13, Math.max(7, 400 / chart.places.length)), symbol: series.symbol, line: { color: color("card"), width: 1.5 } },
        });
      } else if (series.kind === "band") {
        const keep = x.map((_, i) => i).filter((i) => series.low[i] != null && series.high[i] != null);
        const edge = { ...common, x: keep.map((i) => x[i]), mode: "lines", line: { width: 0 }, hoverinfo: "skip", hovertemplate: undefined };
        found.push({ ...edge, y: keep.map((i) => series.low[i]), showlegend: false });
        found.push({ ...edge, y: keep.map((i) => series.high[i]), fill: "tonexty", fillcolor: faded(series.color, 0.2) });
      } else if (series.kind === "area") {
        found.push({ ...common, y: series.y, mode: "lines", line: { width: 0.5, color: own }, fillcolor: own, stackgroup: "all" });
      }
    });
    return found;
  }

  // Draws a chart over steps (axis "x") or minutes ("t"), and its legend into the box if there is one.
  // A click on a place of a map calls choose with its number.
  function draw(element, chart, axis, box, choose) {
    if (!switchedOff.has(element)) switchedOff.set(element, new Set());
    const hidden = switchedOff.get(element);
    const stacked = chart.series.some((series) => series.kind === "area");
    const more = { layout: stacked ? { hovermode: "x unified" } : {} };
    if (!chart.small) more.x = chart.x ?? named(chart, axis === "x" ? "environment steps" : "minutes of training");
    const last = Math.max(0, ...chart.series.map((series) => series[axis].findLast((x) => x != null) ?? 0));
    more.range = chart.x_range ?? (last > 0 ? [0, last * (stacked ? 1 : 1.02)] : undefined);
    const axes = layout(chart, more);
    if (chart.is_equal) Object.assign(axes.yaxis, { scaleanchor: "x", constrain: "domain" });
    if (chart.is_equal) axes.xaxis.constrain = "domain";
    if (chart.picture) {
      const [sizex, sizey] = [chart.x_range[1], chart.range[0]];
      axes.images = [{ source: chart.picture, xref: "x", yref: "y", x: 0, y: 0, sizex, sizey, sizing: "stretch", layer: "below" }];
      Object.assign(axes.xaxis, { visible: false });
      Object.assign(axes.yaxis, { visible: false });
    }
    const isNew = !element.classList.contains("js-plotly-plot");
    Plotly.react(element, traces(chart, axis, hidden), axes, bare);
    if (isNew && choose) element.on("plotly_click", (event) => event.points[0].customdata === undefined || choose(event.points[0].customdata));
    if (box) legend(element, chart, axis, box, hidden, choose);
  }

  // The legend is made again only when it changes: with each new element the browser styles the whole page again.
  function legend(element, chart, axis, box, hidden, choose) {
    const state = JSON.stringify([chart.series.map(({ name, kind, color }) => [name, kind, color]), [...hidden], color("ink")]);
    const isNew = !drawn.has(element) || drawn.get(element).state !== state;
    drawn.set(element, { chart, axis, state });
    if (!isNew) return;
    const focused = [...box.children].indexOf(document.activeElement);
    box.replaceChildren();
    chart.series.forEach((series, number) => {
      if (!series.name || series.kind === "thin") return;
      const button = document.createElement("button");
      const sign = document.createElement("i");
      button.type = "button";
      button.setAttribute("aria-pressed", String(!hidden.has(number)));
      sign.className = series.kind;
      sign.style.background = series.kind === "band" ? faded(series.color, 0.35) : color(series.color);
      if (series.sign) Object.assign(sign, { textContent: series.sign, style: `color: ${color(series.color)}` });
      button.append(sign, series.name);
      button.addEventListener("click", () => {
        if (!hidden.delete(number)) hidden.add(number);
        draw(element, drawn.get(element).chart, drawn.get(element).axis, box, choose);
      });
      box.append(button);
    });
    box.append(saving(element, () => csvOf(drawn.get(element).chart)));
    box.children[focused]?.focus(); // of the keyboard, which was on the button before
  }

  // Buttons that save a chart: two kinds of picture, which Plotly makes, and its numbers.
  function saving(element, rows) {
    const title = element.getAttribute("aria-label") || "chart";
    const filename = title.replace(/[^\p{L}\p{N} ._-]+/gu, "-").slice(0, 80);
    const layout = () => ({ ...element.layout, paper_bgcolor: color("card"), title: { text: plain(title), font: { size: 14 } }, margin: { l: 8, r: 14, t: 40, b: 8 } });
    const picture = (format) => Plotly.downloadImage({ data: element.data, layout: { ...layout(), showlegend: true } }, { format, filename, width: 900, height: 500, scale: 2 });
    const numbers = () => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([rows().map((row) => row.map(cell).join(",")).join("\n") + "\n"], { type: "text/csv" }));
      link.download = `${filename}.csv`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    };
    const box = document.createElement("span");
    box.className = "save";
    for (const [name, save] of [["PNG", () => picture("png")], ["SVG", () => picture("svg")], ["CSV", numbers]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.append(name);
      button.setAttribute("aria-label", `${name}: ${title}`);
      button.addEventListener("click", save);
      box.append(button);
    }
    return box;
  }

  // A cell of a table with commas; a text that a spreadsheet would take for a formula gets an apostrophe.
  const cell = (value) => (value == null ? "" : typeof value === "number" ? value : `"${String(value).replace(/^[=+@-]/, "'$&").replace(/"/g, '""')}"`);
  const csvOf = (chart) => [
    ["series", chart.x ?? "step", ...(chart.x ? [] : ["minutes"]), "value", "low", "high"],
    ...chart.series.flatMap((series) => series.x.map((x, i) => [
      series.name, x, ...(chart.x ? [] : [series.t[i]]), series.y?.[i], series.low?.[i], series.high?.[i],
    ])),
  ];

  const digits = (value) => (Number.isInteger(value) ? {} : { maximumSignificantDigits: 6 });
  const short = (value) => (value == null ? "–" : value.toLocaleString("en-US", digits(value)).replace("-", "−"));
  const rangeOf = (h, i) => `${short(i === 0 ? h.least : h.edges[i])} ${named(h, "to")} ${short(i === h.counts.length - 1 ? h.most : h.edges[i + 1])}`;


  // Draws a histogram; the bar that is chosen has another color, and a click calls choose with the number of its bar.
  function histogram(element, h, chosen, choose, box) {
    const middles = h.counts.map((_, i) => (h.edges[i] + h.edges[i + 1]) / 2);
    const colors = h.counts.map((_, i) => (i === chosen ? color("accent") : color("dots")));
    const text = h.counts.map((n, i) => `${n.toLocaleString("en-US")} ${named(h, "episodes")}<br>${rangeOf(h, i)}`);
    const bars = {
      type: "bar", x: middles, y: h.counts, width: h.edges[1] - h.edges[0], hovertext: text, hovertemplate: "%{hovertext}<extra></extra>",
      marker: { color: colors, line: { color: color("card"), width: 1 } },
    };
    const axes = layout({ y: named(h, "episodes") }, { x: named(h, "return"), layout: { dragmode: false, bargap: 0 } });
    Object.assign(axes.yaxis, { rangemode: "tozero", exponentformat: "none" });
    const isNew = !element.classList.contains("js-plotly-plot");
    Plotly.react(element, [bars], axes, bare);
    drawn.set(element, h);
    const rows = ({ counts, edges }) => [["from", "to", "episodes"], ...counts.map((n, i) => [edges[i], edges[i + 1], n])];
    if (!box?.children.length) box?.append(saving(element, () => rows(drawn.get(element))));
    if (isNew) element.on("plotly_click", (event) => choose(event.points[0].pointNumber));
  }

  return { draw, histogram, rangeOf, short };
})();
