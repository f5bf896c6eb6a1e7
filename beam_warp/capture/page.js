// Draws the rig of a capture and its images; what they are is in the element "data".
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const axis = (title) => ({ title: { text: title }, color: "#777", gridcolor: "#e4e4e4", zerolinecolor: "#ccc", backgroundcolor: "#fafafa", showspikes: false });

/** Joins polylines into one trace, with gaps between them. */
function lines(polylines, options) {
  const x = [], y = [], z = [];
  for (const polyline of polylines) {
    for (const [a, b, c] of polyline) { x.push(a); y.push(b); z.push(c); }
    x.push(null); y.push(null); z.push(null);
  }
  return { type: "scatter3d", mode: "lines", x, y, z, hoverinfo: "skip", ...options };
}

/** The edges of a camera's frustum: its apex to every corner, and around the corners. */
function frustum(camera) {
  const [a, b, c, d] = camera.corners;
  const p = camera.position;
  return [[p, a, b, p, c, d, p], [a, d], [b, c]];
}

/** Images in the frustums, as two triangles a pixel; of a subject with a mask, that alone. */
function pictures(cameras) {
  const mesh = { type: "mesh3d", x: [], y: [], z: [], i: [], j: [], k: [], facecolor: [], hoverinfo: "skip", flatshading: true,
                 lighting: { ambient: 1, diffuse: 0, specular: 0, fresnel: 0 }, name: "images", showlegend: true };
  for (const camera of cameras) {
    if (!camera.image) continue;
    const { rows, columns, colors } = camera.image;
    const [a, b, c, d] = camera.corners;
    const start = mesh.x.length;
    for (let row = 0; row <= rows; row++) {
      for (let column = 0; column <= columns; column++) {
        const u = column / columns, v = row / rows;
        const at = (n) => (1 - v) * ((1 - u) * a[n] + u * b[n]) + v * ((1 - u) * d[n] + u * c[n]);
        mesh.x.push(at(0)); mesh.y.push(at(1)); mesh.z.push(at(2));
      }
    }
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const color = "#" + colors.slice(6 * (row * columns + column), 6 * (row * columns + column) + 6);
        if (color[1] === "-") continue;
        const corner = start + row * (columns + 1) + column;
        mesh.i.push(corner, corner + 1);
        mesh.j.push(corner + 1, corner + columns + 2);
        mesh.k.push(corner + columns + 1, corner + columns + 1);
        mesh.facecolor.push(color, color);
      }
    }
  }
  return mesh;
}

function traces() {
  const found = [];
  if (data.points.length) {
    found.push({ type: "scatter3d", mode: "markers", name: "points", x: data.points.map((p) => p[0]), y: data.points.map((p) => p[1]),
                 z: data.points.map((p) => p[2]), marker: { size: 1.6, color: data.pointColors.map((c) => "#" + c) }, hoverinfo: "skip" });
  }
  if (data.volume) found.push(lines(data.volume, { name: data.volumeName, line: { color: data.volumeColor, width: 3 } }));
  for (const kind of data.kinds) {
    const own = data.cameras.filter((camera) => camera.kind === kind.name);
    found.push(lines(own.flatMap(frustum), { name: kind.title, legendgroup: kind.name, line: { color: kind.color, width: 3 } }));
    found.push({ type: "scatter3d", mode: "markers", x: own.map((c) => c.position[0]), y: own.map((c) => c.position[1]), z: own.map((c) => c.position[2]),
                 text: own.map((c) => c.text), hovertemplate: "%{text}<extra></extra>", marker: { size: 3.5, color: kind.color },
                 legendgroup: kind.name, showlegend: false });
  }
  found.push(pictures(data.cameras));
  found.push(lines([], { name: "pointed at", showlegend: false, line: { color: "#111", width: 7 } }));
  return found;
}

const plot = document.getElementById("rig");
const layout = {
  margin: { l: 0, r: 0, t: 0, b: 0 }, legend: { x: 0, y: 1, bgcolor: "rgba(255,255,255,0.7)" }, uirevision: "rig", paper_bgcolor: "#fff",
  scene: { aspectmode: "data", xaxis: axis("x [m]"), yaxis: axis("y [m]"), zaxis: axis("z [m]"),
           camera: { up: { x: 0, y: 0, z: 1 }, eye: { x: 0.75, y: -1.35, z: 0.65 } } },
};
const drawn = traces();
Plotly.newPlot(plot, drawn, layout, { responsive: true, displaylogo: false });

/** Draws the frustum of one camera thick, or of none. */
function pointAt(name) {
  const camera = data.cameras.find((other) => other.name === name);
  const { x, y, z } = lines(camera ? frustum(camera) : [], {});
  Plotly.restyle(plot, { x: [x], y: [y], z: [z] }, [drawn.length - 1]);
}

for (const figure of document.querySelectorAll("figure[data-camera]")) {
  figure.addEventListener("mouseenter", () => pointAt(figure.dataset.camera));
  figure.addEventListener("mouseleave", () => pointAt(null));
}
