// A chart or a histogram of rejeu.logs.charts, drawn again when its data change. Texts become text nodes.
export default {
  template: `<div class="chart"><div class="legend" ref="legend"></div><div class="plot" ref="plot" role="img" :aria-label="name" :style="{height: height}"></div></div>`,
  props: { chart: Object, name: String, axis: String, height: String, chosen: Number },
  mounted() {
    this.draw();
    this.colors = new MutationObserver(() => this.draw());
    this.colors.observe(document.body, { attributes: true, attributeFilter: ["class"] });
    this.sizes = new ResizeObserver(() => this.fit());
    this.sizes.observe(this.$refs.plot); // a chart in a folded part is drawn when that opens
  },
  beforeUnmount() {
    this.colors.disconnect();
    this.sizes.disconnect();
  },
  watch: { chart: "draw", axis: "draw", chosen: "draw" },
  methods: {
    fit() {
      const { plot } = this.$refs;
      if (!plot.classList.contains("js-plotly-plot")) this.draw();
      else if (plot.offsetWidth) Plotly.Plots.resize(plot);
    },
    draw() {
      const { plot, legend } = this.$refs;
      if (!this.chart || !plot || !plot.offsetWidth) return;
      const choose = (number) => this.$emit("choose", number);
      if (this.chart.counts) RejeuCharts.histogram(plot, this.chart, this.chosen, choose, legend);
      else RejeuCharts.draw(plot, this.chart, this.axis, legend, choose);
    },
  },
};
