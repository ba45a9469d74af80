// Values under the pointer: the points are read back from the drawn lines.
const readout = document.createElement("div");
readout.className = "readout";
readout.hidden = true;
document.body.append(readout);
for (const chart of document.querySelectorAll("svg.chart[data-range]")) {
  const [left, top, right, bottom] = chart.dataset.frame.split(" ").map(Number);
  const [x0, x1, y0, y1] = chart.dataset.range.split(" ").map(Number);
  const value = (axis, laid) => (chart.dataset.log.includes(axis) ? 10 ** laid : laid);
  const lines = [...chart.querySelectorAll("polyline")].map((line) => ({
    label: line.dataset.label,
    points: line.getAttribute("points").split(" ").map((point) => point.split(",").map(Number)),
  }));
  const cursor = document.createElementNS(chart.namespaceURI, "path");
  cursor.setAttribute("class", "cursor");
  chart.append(cursor);
  const hide = () => { readout.hidden = true; cursor.setAttribute("d", ""); };
  chart.addEventListener("pointerleave", hide);
  chart.addEventListener("pointermove", (event) => {
    const box = chart.getBoundingClientRect();
    const scale = chart.viewBox.baseVal.width / box.width;
    const x = (event.clientX - box.left) * scale;
    if (x < left || x > right) { hide(); return; }
    cursor.setAttribute("d", `M${x} ${top}V${bottom}`);
    const rows = lines.map(({ label, points }) => {
      const near = points.reduce((best, point) => (Math.abs(point[0] - x) < Math.abs(best[0] - x) ? point : best));
      const y = value("y", y0 + ((bottom - near[1]) / (bottom - top)) * (y1 - y0));
      return `${label || chart.getAttribute("aria-label")}: ${y.toPrecision(4)} ${chart.dataset.unit}`;
    });
    const at = value("x", x0 + ((x - left) / (right - left)) * (x1 - x0));
    readout.textContent = [chart.dataset.log.includes("x") ? at.toPrecision(3) : at.toFixed(2), ...rows].join("\n");
    readout.hidden = false;
    readout.style.left = `${Math.min(event.clientX + 14, innerWidth - readout.offsetWidth - 8)}px`;
    readout.style.top = `${event.clientY + 14}px`;
  });
}
