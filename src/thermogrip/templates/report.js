"use strict";
(() => {
  const NOTHING = "\u2013", FINGER = 22;

  for (const box of document.querySelectorAll(".commands")) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = "Copy";
    button.addEventListener("click", async () => {
      const words = box.querySelector("pre");
      try {
        await navigator.clipboard.writeText(words.textContent);
        button.textContent = "Copied";
      } catch {
        getSelection().selectAllChildren(words);
        button.textContent = "Selected";
      }
      setTimeout(() => { button.textContent = "Copy"; }, 2000);
    });
    box.append(button);
  }

  // little-endian float32, NaN where there is a gap
  const numbers = text => {
    const bytes = Uint8Array.from(atob(text), sign => sign.charCodeAt(0)), view = new DataView(bytes.buffer);
    return Array.from({length: bytes.length / 4}, (_, k) => view.getFloat32(4 * k, true))
      .map(value => Number.isNaN(value) ? null : value);
  };
  const shown = value => value == null ? NOTHING : String(Number(value.toPrecision(4)));
  const ticks = (self, splits) => splits.map(value => value == null ? "" : String(Number(value.toPrecision(6))));
  const dashes = {"-": [], "--": [7, 4], ":": [2, 3], "-.": [7, 3, 2, 3]};

  const told = (value, low, high) => shown(value) + (low == null ? "" : ` (${shown(low)} to ${shown(high)})`);
  const longest = words => words.reduce((a, b) => b.length > a.length ? b : a, "");

  function legend(chart, panel, plot, places, box) {
    const line = document.createElement("div"), entries = new Map();
    line.className = "legend";
    const at = line.appendChild(document.createElement("span"));
    at.className = "at";
    panel.curves.forEach((curve, k) => {
      if (!curve.label) return;
      if (!entries.has(curve.label)) {
        const button = document.createElement("button"), value = document.createElement("output");
        button.type = "button";
        button.title = "show or hide";
        button.innerHTML = '<svg width="26" height="10" aria-hidden="true"><path d="M0 5H26" fill="none"/></svg>';
        const path = button.querySelector("path");
        path.setAttribute("stroke", curve.colour);
        path.setAttribute("stroke-width", Math.min(4, curve.width + 0.6));
        path.setAttribute("stroke-dasharray", dashes[curve.dash || ":"].join(" "));
        button.append(document.createTextNode(` ${curve.label} `), value);
        const entry = {button, value, curves: [], on: true};
        button.setAttribute("aria-pressed", "true");
        button.addEventListener("click", () => {
          entry.on = !entry.on;
          button.setAttribute("aria-pressed", String(entry.on));
          plot().batch(() => entry.curves.forEach(j => {
            for (const s of places[j]) plot().setSeries(s, {show: entry.on});
          }));
        });
        entries.set(curve.label, entry);
        line.append(button);
      }
      entries.get(curve.label).curves.push(k);
    });
    box.append(line);
    // room for the numbers is there before they are, so that no plot moves under the pointer
    const some = at => chart.arrays[at].filter((_, k, all) => k % Math.ceil(all.length / 200) === 0);
    for (const {value, curves: [k]} of entries.values()) {
      const [y, low, high] = ["y", "low", "high"].map(name => panel.curves[k][name] == null ? null : some(panel.curves[k][name]));
      value.textContent = longest(y.map((_, j) => told(y[j], low?.[j], high?.[j])));
      value.style.minWidth = `${value.offsetWidth}px`;
    }
    at.textContent = longest(some(panel.curves[0].x).map(shown)) + panel.unit;
    at.style.minWidth = `${at.offsetWidth}px`;
    line.style.minHeight = `${line.offsetHeight}px`;
    for (const {value} of entries.values()) value.textContent = "";
    at.textContent = "";
    return self => {
      const {idx, idxs, top} = self.cursor;
      at.textContent = idx == null ? "" : `${shown(self.data[0][idx])}${panel.unit}`;
      for (const entry of entries.values()) {
        if (idx == null) { entry.value.textContent = ""; continue; }
        const near = entry.curves.map(k => places[k].map(s => self.data[s][idxs[s]]))
          .filter(own => own[0] != null)
          .sort((a, b) => Math.abs(self.valToPos(a[0], "y") - top) - Math.abs(self.valToPos(b[0], "y") - top));
        const [value, low, high] = near[0] ?? [];
        entry.value.textContent = told(value, low, high);
      }
      line.style.minHeight = `${line.offsetHeight}px`;  // what has grown once stays, and the plot under it too
    };
  }

  function draw(figure, chart, panel, key, box) {
    // curves of one axis are a table; tables of several are joined, and what is missing is no gap
    const tables = new Map(), places = [];
    for (const [k, curve] of panel.curves.entries()) {
      if (!tables.has(curve.x)) tables.set(curve.x, []);
      const own = [curve.y, ...(curve.low == null ? [] : [curve.low, curve.high])];
      places[k] = own.map(y => tables.get(curve.x).push({curve, y, main: y === curve.y}) - 1);
    }
    let series = [{}], first = 1;
    const data = [];
    for (const [x, own] of tables) {
      panel.curves.forEach((curve, k) => { if (curve.x === x) places[k] = places[k].map(s => s + first); });
      first += own.length;
      data.push([chart.arrays[x], ...own.map(one => chart.arrays[one.y])]);
      series = series.concat(own.map(({curve, main}) => ({
        stroke: main ? curve.colour : "transparent",
        width: main ? curve.width : 0,
        dash: dashes[curve.dash],
        points: main && !curve.dash ? {show: true, size: 7, fill: curve.colour} : {show: false},
        paths: !curve.dash ? () => null : curve.step ? uPlot.paths.stepped({align: 1}) : undefined,
      })));
    }
    const bands = panel.curves.flatMap((curve, k) => curve.low == null ? [] :
      [{series: [places[k][2], places[k][1]], fill: curve.colour + "33"}]);
    const axis = {font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif",
                  stroke: "#1d2733", values: ticks, grid: {stroke: "#dde3ea", width: 1}, ticks: {stroke: "#8795a3", size: 5}};
    const across = (self, x) => Math.round(self.valToPos(x, "x", true));
    let plot, tell = () => {};
    const options = {
      width: Math.max(200, box.clientWidth), height: 60 + 95 * panel.height,
      legend: {show: false},
      scales: {x: {time: false, distr: chart.log ? 3 : 1}, y: {distr: panel.log ? 3 : 1}},
      axes: [{...axis, label: panel.last ? chart.x_label : undefined, labelSize: 18, size: 26},
             {...axis, label: panel.label, labelSize: 18, size: 54}],
      cursor: {sync: {key, scales: ["x", null]}, drag: {x: true, y: false}, y: false,
               points: {size: 6}},
      series, bands,
      hooks: {
        drawClear: [self => {
          const {ctx, bbox: {left, top, width, height}} = self;
          ctx.save();
          ctx.beginPath();
          ctx.rect(left, top, width, height);
          ctx.clip();
          ctx.fillStyle = "#e6eaef";
          for (const [a, b] of panel.shaded) ctx.fillRect(across(self, a), top, Math.max(1, across(self, b) - across(self, a)), height);
          ctx.strokeStyle = "#1d2733";
          ctx.setLineDash([2, 4]);
          for (const x of panel.marks) { ctx.beginPath(); ctx.moveTo(across(self, x), top); ctx.lineTo(across(self, x), top + height); ctx.stroke(); }
          ctx.restore();
        }],
        setCursor: [self => tell(self)],
        setScale: [(self, name) => {
          if (name !== "x") return;
          const all = self.data[0], {min, max} = self.scales.x;
          figure.classList.toggle("zoomed", min > all[0] || max < all[all.length - 1]);
        }],
      },
    };
    if (panel.title) box.appendChild(document.createElement("h3")).textContent = panel.title;
    tell = legend(chart, panel, () => plot, places, box);
    plot = new uPlot(options, data.length > 1 ? uPlot.join(data) : data[0], box);
    fingers(plot, figure);
    return plot;
  }

  // one finger reads and scrolls the page, two fingers zoom
  function fingers(plot, figure) {
    let begun = null;
    const place = touch => plot.posToVal(touch.clientX - plot.over.getBoundingClientRect().left, "x");
    plot.over.addEventListener("touchstart", event => {
      begun = event.touches.length === 2 ? [...event.touches].map(place).sort((a, b) => a - b) : null;
    }, {passive: true});
    plot.over.addEventListener("touchmove", event => {
      if (!begun || event.touches.length !== 2) return;
      event.preventDefault();
      const rect = plot.over.getBoundingClientRect();
      const [a, b] = [...event.touches].map(touch => touch.clientX - rect.left).sort((p, q) => p - q);
      const scale = (begun[1] - begun[0]) / Math.max(FINGER, b - a);
      const min = begun[0] - a * scale;
      for (const one of figure.plots) one.setScale("x", {min, max: min + rect.width * scale});
    }, {passive: false});
  }

  function chartOf(figure, k) {
    const chart = JSON.parse(figure.querySelector("script").textContent);
    chart.arrays = chart.arrays.map(numbers);
    const room = figure.querySelector(".panels");
    figure.plots = [];
    const boxes = [];
    for (const column of chart.columns) {
      const side = room.appendChild(document.createElement("div"));
      for (const panel of column) boxes.push([panel, side.appendChild(document.createElement("div"))]);
    }
    for (const [panel, box] of boxes) figure.plots.push(draw(figure, chart, panel, `figure${k}`, box));
    const whole = figure.querySelector(".whole");
    whole.addEventListener("click", () => {
      for (const plot of figure.plots) {
        const all = plot.data[0];
        plot.setScale("x", {min: all[0], max: all[all.length - 1]});
      }
    });
    new ResizeObserver(() => {
      for (const [j, [, box]] of boxes.entries()) {
        const plot = figure.plots[j], width = Math.max(200, box.clientWidth);
        if (width !== plot.width) plot.setSize({width, height: plot.height});
      }
    }).observe(room);
  }

  // what is folded has no width: it is drawn when it is opened
  for (const [k, figure] of [...document.querySelectorAll("figure.chart")].entries()) {
    document.documentElement.classList.add("drawn");
    const folded = figure.closest("details");
    if (folded) folded.addEventListener("toggle", () => chartOf(figure, k), {once: true});
    else chartOf(figure, k);
  }
})();
