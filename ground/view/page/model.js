// What the page knows of each vehicle: scenes are unpacked and merged into what is there already.

/** One message of the server: {header, arrays: {name: {shape, from, values}}}; values are float32, row by row. */
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  let offset = 4 + length;
  for (const { name, shape, from } of header.arrays) {
    const size = shape.reduce((product, n) => product * n, 1);
    arrays[name] = { shape, from: from ?? 0, values: new Float32Array(buffer, offset, size) };
    offset += 4 * size;
  }
  return { header, arrays };
}

/** A vehicle that nothing is known of yet. */
export function unknown(name) {
  return {
    name, label: name, search: name, scene: null, // its name on a map, and the search that it is of
    particles: new Float32Array(0), // x, y, weight, x, y, weight, ...
    track: [], // x, y, x, y, ...
    measurements: [], happenings: [],
    walls: [], // outlines, [[x, y], …]
    fence: [], // the outline that no way leaves
    plume: null, // {cells, values, most}
    fresh: { measurements: true, happenings: true, plume: true }, // what has changed since it was last drawn
  };
}

function splice(list, from, rows) {
  list.length = Math.min(list.length, from);
  for (const row of rows) list.push(row);
}

/** Merge a scene into a model. */
export function merge(model, { header, arrays }) {
  model.scene = header;
  for (const name of ["measurements", "happenings"]) {
    const { from, rows } = header[name];
    if (rows.length || from < model[name].length) model.fresh[name] = true;
    splice(model[name], from, rows);
  }
  for (const name of ["walls", "fence"]) if (header[name]) model[name] = header[name];
  if (arrays.track) splice(model.track, 2 * arrays.track.from, arrays.track.values);
  if (arrays.particles) model.particles = arrays.particles.values;
  if (arrays.plume) {
    const { shape, values } = arrays.plume;
    model.plume = { cells: shape[0], values, most: values.reduce((a, b) => Math.max(a, b), 0) };
    model.fresh.plume = true;
  }
}

// Columns of a measurement, as of `_row` in wire.py.
const STEP = 0, TIME = 1, GAS = 4, SPREAD = 5, WIND = 9, RATE = 11, P = 14, EVIDENCE = 15, SIZE = 16;
const KG_H = 3.6; // of a g/s

/** Columns of the measurements, for the charts. */
export function columns(model) {
  const rows = model.measurements;
  const of = (column, factor = 1) => rows.map((row) => (Number.isFinite(row[column]) ? factor * row[column] : null));
  return {
    steps: of(STEP), times: of(TIME), gas: of(GAS), spread: of(SPREAD), p: of(P), evidence: of(EVIDENCE), size: of(SIZE),
    rate: [of(RATE, KG_H), of(RATE + 1, KG_H), of(RATE + 2, KG_H)],
    from: rows.map(({ [WIND]: x, [WIND + 1]: y }) => (Number.isFinite(x) ? ((Math.atan2(x, y) * 180) / Math.PI + 360) % 360 : null)),
  };
}

/** The measurements with a reading: a vehicle that has left its search takes none, and the belief goes on. */
export function readings(model) {
  return model.measurements.filter((row) => row[GAS] !== null);
}

/** The newest measurement as an object; null if there is none. */
export function newest(model) {
  const row = model.measurements.at(-1);
  return row ? { step: row[STEP], gas: row[GAS], spread_m: row[SPREAD] } : null;
}
