// Points of a spectrum that are dragged.
studio.spectrum = function (id, series) {
  const chart = getElement(id).chart;
  if (!chart) return setTimeout(() => studio.spectrum(id, series), 30);
  if (chart.studioReady) return;
  chart.studioReady = true;
  const zr = chart.getZr();
  let held = null;
  const points = () => (chart.getOption().series[series] || { data: [] }).data;
  zr.on("mousedown", (e) => {
    let best = 14;
    held = null;
    points().forEach((point, k) => {
      const [x, y] = chart.convertToPixel({ seriesIndex: series }, point);
      const far = Math.hypot(x - e.offsetX, y - e.offsetY);
      if (far < best) [best, held] = [far, { k, wavelength: point[0], value: point[1] }];
    });
  });
  zr.on("mousemove", (e) => {
    if (!held) return;
    const y = chart.convertFromPixel({ seriesIndex: series }, [e.offsetX, e.offsetY])[1];
    held.value = Math.min(1, Math.max(0, y));
    held.moved = true;
    const data = points().map((point, k) => (k === held.k ? [point[0], held.value] : point));
    const all = chart.getOption().series.map(() => ({}));
    all[series] = { data };
    chart.setOption({ series: all });
  });
  zr.on("mouseup", () => {
    if (held && held.moved)
      studio.sent(emitEvent, "studio_spectrum", { wavelength: held.wavelength, value: held.value, version: studio.version });
    held = null;
  });
  zr.on("globalout", () => { held = null; });
};
