// Draws the report's figures from the JSON blocks beside them.
const plots = [];
// The height that suits a width: as designed, or less where equal axes would leave it empty.
function height(plot, width) {
  const meta = plot.layout.meta;
  return meta ? Math.min(plot.tall, Math.round(width * meta.ratio + meta.extra)) : plot.tall;
}
function fit(plot, width, share) {
  const tall = Math.round(share * height(plot, width));
  plot.style.height = tall + "px";
  Plotly.relayout(plot, {width: width, height: tall});
}
for (const data of document.querySelectorAll("script[type='application/json']")) {
  const figure = JSON.parse(data.textContent);
  const plot = document.getElementById(data.dataset.plot);
  plot.layout = figure.layout;
  plot.tall = figure.layout.height;
  figure.layout.width = plot.clientWidth;
  figure.layout.height = height(plot, plot.clientWidth);
  plot.style.height = figure.layout.height + "px";
  Plotly.newPlot(plot, figure.data, figure.layout,
    {displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"]});
  plots.push(plot);
}
let shown = innerWidth;
function refit() { plots.forEach(plot => fit(plot, plot.parentElement.clientWidth, 1)); }
addEventListener("resize", () => { if (innerWidth !== shown) { shown = innerWidth; refit(); } });
// Paper has another width than the screen, and two figures should share a page.
addEventListener("beforeprint", () => plots.forEach(plot => fit(plot, 640, 0.75)));
addEventListener("afterprint", refit);
