// Draws the table of a study: every factor has toggles, and the Pareto frontier is that of what is shown.
// This is the body of a function of data, a table, and root, the element that it is drawn in.
"use strict";

const COLORS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"];
const SYMBOLS = ["circle", "triangle-up", "square", "diamond", "triangle-down", "cross", "x"];
const DASHES = ["solid", "dash", "dot", "dashdot"];
const CROWDED = 0.1; // decades

const subject = data.subject;
const axisOf = Object.fromEntries(subject.axes.map((axis) => [axis.name, axis]));
const hidden = Object.fromEntries(subject.axes.map((axis) => [axis.name, new Set()]));
const colorBy = {}; // metric name -> axis name, once somebody has chosen one

function element(tag, text, parent, attributes = {}) {
  const made = document.createElement(tag);
  if (text) made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (parent) parent.appendChild(made);
  return made;
}

function labelOf(axis, level) {
  return `${level} ${axis.unit}`.trim();
}

function significant(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e-3 && size < 1e5 ? String(Number(value.toPrecision(3))) : value.toExponential(2);
}

function withUnit(title, unit) {
  return unit ? `${title} [${unit}]` : title;
}

function shownRows(metric) {
  return data.rows.filter(
    (row) =>
      metric.name in row.errors &&
      subject.axes.every((axis) => !(axis.name in row.settings) || !hidden[axis.name].has(row.settings[axis.name])),
  );
}

function frontierOf(rows, metric) {
  const sorted = [...rows].sort(
    (a, b) => a.cost[0] - b.cost[0] || a.errors[metric.name][0] - b.errors[metric.name][0],
  );
  const kept = [];
  for (const row of sorted) {
    const last = kept[kept.length - 1];
    const error = row.errors[metric.name][0];
    if (!last || error < (1 - data.tolerance) * last.errors[metric.name][0]) kept.push(row);
  }
  return kept;
}

function linesOf(rows) {
  const ladder = axisOf[subject.ladder];
  const groups = new Map();
  for (const row of rows) {
    const key = JSON.stringify(
      subject.axes.filter((axis) => axis !== ladder).map((axis) => row.settings[axis.name] ?? null),
    );
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(row);
  }
  const place = (row) => ladder.levels.indexOf(row.settings[ladder.name]);
  return [...groups.values()].map((group) => group.sort((a, b) => place(a) - place(b)));
}

function escaped(text) {
  return String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;");
}

function hoverOf(row, metric) {
  const error = row.errors[metric.name];
  const settings = subject.axes
    .filter((axis) => axis.name in row.settings)
    .map((axis) => `${escaped(axis.title)}: <b>${escaped(row.settings[axis.name])}</b>`);
  return [
    ...settings,
    `${withUnit("cost", subject.cost_unit)}: <b>${significant(row.cost[0])}</b> ` +
      `(${significant(row.cost[1])} to ${significant(row.cost[2])})`,
    `error: <b>${significant(error[0])}</b> (${significant(error[1])} to ${significant(error[2])})`,
  ].join("<br>");
}

function styleOf(name, values, row) {
  if (!name) return values[0];
  if (!(name in row.settings)) return values[values.length - 1];
  return values[axisOf[name].levels.indexOf(row.settings[name]) % values.length];
}

function bars(rows, pick) {
  return {
    type: "data",
    symmetric: false,
    array: rows.map((row) => pick(row)[2] - pick(row)[0]),
    arrayminus: rows.map((row) => pick(row)[0] - pick(row)[1]),
    thickness: 1,
    width: 2,
  };
}

function drawCurves(metric, plot, list) {
  const rows = shownRows(metric).filter((row) => row.cost[0] > 0 && row.errors[metric.name][0] > 0);
  const by = colorBy[metric.name] ?? metric.color;
  const errorOf = (row) => row.errors[metric.name];
  const apart = metric.apart ? axisOf[metric.apart] : null;
  // Settings with another truth do not compete: the frontier is about the first level that is shown.
  const first = apart ? apart.levels.find((level) => rows.some((row) => row.settings[apart.name] === level)) : null;
  const isRival = (row) => !apart || row.settings[apart.name] === first;
  const frontier = frontierOf(rows.filter(isRival), metric);
  const places = []; // whether a number stands above: only where the one before stands below, and near
  frontier.forEach((row, index) => {
    const near = (a, b) => Math.abs(Math.log10(a / b)) < CROWDED;
    const last = frontier[index - 1];
    places.push(
      index > 0 && !places[index - 1] && near(row.cost[0], last.cost[0]) && near(errorOf(row)[0], errorOf(last)[0]),
    );
  });
  const traces = [
    {
      x: frontier.map((row) => row.cost[0]),
      y: frontier.map((row) => errorOf(row)[0]),
      mode: "lines+markers",
      line: { shape: "hv", width: 9, color: "rgba(255,194,10,0.5)" },
      marker: { size: 15, color: "rgba(0,0,0,0)", line: { width: 1.2, color: "black" } },
      name: "Pareto frontier",
      hoverinfo: "skip",
    },
  ];
  for (const group of linesOf(rows)) {
    const color = styleOf(by, COLORS, group[0]);
    traces.push({
      x: group.map((row) => row.cost[0]),
      y: group.map((row) => errorOf(row)[0]),
      error_x: { ...bars(group, (row) => row.cost), color },
      error_y: { ...bars(group, errorOf), color },
      text: group.map((row) => hoverOf(row, metric)),
      hovertemplate: "%{text}<extra></extra>",
      mode: "lines+markers",
      line: { color, width: 1.2, dash: styleOf(metric.line, DASHES, group[0]) },
      marker: { color, size: 8, symbol: group.map((row) => styleOf(metric.marker, SYMBOLS, row)) },
      opacity: isRival(group[0]) ? 1 : 0.35,
      showlegend: false,
    });
  }
  const present = by ? axisOf[by].levels.filter((level) => rows.some((row) => row.settings[by] === level)) : [];
  for (const level of present) {
    const color = COLORS[axisOf[by].levels.indexOf(level) % COLORS.length];
    traces.push({ x: [null], y: [null], mode: "lines", line: { color, width: 4 }, name: labelOf(axisOf[by], level) });
  }
  for (const [name, styles, part] of [
    [metric.marker, SYMBOLS, "marker"],
    [metric.line, DASHES, "line"],
  ]) {
    const levels = name ? axisOf[name].levels.filter((level) => rows.some((row) => row.settings[name] === level)) : [];
    for (const level of levels.length > 1 ? levels : []) {
      const style = styles[axisOf[name].levels.indexOf(level) % styles.length];
      traces.push({
        x: [null],
        y: [null],
        mode: part === "line" ? "lines" : "markers",
        [part]: part === "line" ? { color: "#555", dash: style } : { color: "#555", size: 8, symbol: style },
        name: `${axisOf[name].title.toLowerCase()} ${labelOf(axisOf[name], level)}`,
      });
    }
  }
  const layout = {
    xaxis: { type: "log", title: { text: withUnit(subject.cost, subject.cost_unit) }, dtick: 1, gridcolor: "#ddd", minor: { showgrid: true } },
    yaxis: {
      type: "log",
      title: { text: withUnit(metric.title, metric.unit) },
      dtick: 1,
      exponentformat: "power",
      gridcolor: "#ddd",
      minor: { showgrid: true },
    },
    annotations: frontier.map((row, index) => {
      // Below and left, where nothing is; above and right of a neighbour that is too near
      const side = places[index] ? 1 : -1;
      return {
        x: Math.log10(row.cost[0]),
        y: Math.log10(errorOf(row)[0]),
        text: `<b>${index + 1}</b>`,
        showarrow: false,
        xshift: 11 * side,
        yshift: 11 * side,
        font: { size: 13, color: "black" },
      };
    }),
    shapes:
      metric.floor > 0 && rows.some((row) => errorOf(row)[0] < 30 * metric.floor)
        ? [
            {
              type: "line",
              xref: "paper",
              x0: 0,
              x1: 1,
              y0: metric.floor,
              y1: metric.floor,
              line: { color: "#555", width: 1, dash: "dot" },
              label: { text: "error of the reference", textposition: "end", font: { size: 11, color: "#555" } },
            },
          ]
        : [],
    legend: { orientation: "h", x: 0, y: 1.01, yanchor: "bottom", font: { size: 11 } },
    margin: { l: 70, r: 15, t: 10, b: 50 },
    height: 560,
    hoverlabel: { align: "left" },
    plot_bgcolor: "white",
  };
  if (!rows.length) {
    const text = "Nothing is left to show: switch on a level of every factor.";
    layout.annotations.push({ text, xref: "paper", yref: "paper", x: 0.5, y: 0.5, showarrow: false });
  }
  Plotly.react(plot, traces, layout, { responsive: true, displaylogo: false });
  listFrontier(frontier, metric, list);
}

function listFrontier(frontier, metric, list) {
  list.replaceChildren();
  const own = data.rows.filter((row) => metric.name in row.errors);
  const axes = subject.axes.filter((axis) => new Set(own.map((row) => row.settings[axis.name])).size > 1);
  const head = element("tr", "", element("thead", "", list));
  for (const title of ["", ...axes.map((axis) => axis.title), withUnit("Cost", subject.cost_unit), withUnit("Error", metric.unit)]) element("th", title, head);
  const body = element("tbody", "", list);
  frontier.forEach((row, index) => {
    const line = element("tr", "", body);
    element("td", String(index + 1), line);
    for (const axis of axes) element("td", String(row.settings[axis.name] ?? ""), line);
    element("td", significant(row.cost[0]), line);
    element("td", significant(row.errors[metric.name][0]), line);
  });
}

function drawEffect(metric, plot) {
  const axis = axisOf[metric.by];
  const rows = shownRows(metric);
  const first = axis.levels
    .map((level) => rows.find((row) => row.settings[axis.name] === level))
    .filter((row) => row !== undefined);
  const errorOf = (row) => row.errors[metric.name];
  const trace = {
    type: "bar",
    orientation: "h",
    y: first.map((row) => labelOf(axis, row.settings[axis.name]) + " "),
    x: first.map((row) => errorOf(row)[0]),
    error_x: bars(first, errorOf),
    marker: { color: "#56B4E9" },
    hovertemplate: "%{x:.3g}<extra></extra>",
  };
  const layout = {
    xaxis: { title: { text: withUnit(metric.title, metric.unit) }, rangemode: "tozero" },
    yaxis: { type: "category", autorange: "reversed", automargin: true, title: { text: axis.title } },
    margin: { l: 70, r: 15, t: 10, b: 50 },
    height: 120 + 34 * first.length,
  };
  Plotly.react(plot, [trace], layout, { responsive: true, displaylogo: false });
}

function build() {
  element("h1", subject.title, root);
  const planned = subject.planned > data.rows.length ? ` of ${subject.planned} planned` : "";
  element(
    "p",
    "Lower left is better. Numbered: the Pareto frontier of what is shown, which no other setting beats in both cost " +
      `and error. ${data.rows.length} settings measured${planned}. Point at a mark for its settings.`,
    root,
  );
  const controls = element("div", "", root, { class: "controls" });
  const draws = [];
  const draw = () => draws.forEach((each) => each());
  for (const axis of subject.axes.filter((each) => each.levels.length > 1)) {
    const box = element("fieldset", "", controls, { title: axis.sentence });
    element("legend", axis.title, box);
    for (const level of axis.levels) {
      const label = element("label", "", box);
      const input = element("input", "", label, { type: "checkbox", checked: "" });
      label.append(` ${labelOf(axis, level)}`);
      input.addEventListener("change", () => {
        if (input.checked) hidden[axis.name].delete(level);
        else hidden[axis.name].add(level);
        draw();
      });
    }
  }
  const panels = element("div", "", root, { class: "panels" });
  for (const metric of subject.metrics) {
    const own = data.rows.filter((row) => metric.name in row.errors);
    const choices = subject.axes.filter((axis) => new Set(own.map((row) => row.settings[axis.name])).size > 1);
    if (!own.length || (metric.by && !choices.includes(axisOf[metric.by]))) continue;
    const panel = element("section", "", panels);
    element("h2", metric.title, panel);
    if (metric.sentence) element("p", metric.sentence, panel);
    if (metric.by) {
      const plot = element("div", "", panel);
      draws.push(() => drawEffect(metric, plot));
      continue;
    }
    const label = element("label", "Colours tell apart ", panel);
    const select = element("select", "", label);
    for (const axis of choices) element("option", axis.title, select, { value: axis.name });
    if (choices.includes(axisOf[metric.color])) select.value = metric.color;
    select.addEventListener("change", () => {
      colorBy[metric.name] = select.value;
      draw();
    });
    const plot = element("div", "", panel);
    const list = element("table", "", panel);
    draws.push(() => drawCurves(metric, plot, list));
  }
  const notes = element("dl", "", root);
  for (const [title, text] of Object.entries(subject.notes)) {
    element("dt", title, notes);
    element("dd", text, notes);
  }
  for (const axis of subject.axes.filter((each) => each.sentence)) {
    element("dt", axis.title, notes);
    element("dd", axis.sentence, notes);
  }
  draw();
}

build();
