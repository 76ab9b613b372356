// Which part of the world the map shows: all of it, the belief, or what people chose. Metres to pixels and back.

const LEFT = 38, RIGHT = 14, TOP = 80, BOTTOM = 30; // px kept free around what is shown in full
const SMALLEST_M = 1, LARGEST = 20; // of what can be zoomed to: metres, and times the area

/** Whether a vehicle has said where it is. */
export const isPlaced = (craft) => Number.isFinite(craft?.x) && Number.isFinite(craft?.y);

/** The scale and the place of a view: {x(m) and y(m) to px, east(px) and north(px) to m, scale px/m, left, top, width, height px}. */
export function viewOf([x, y], scale, { left, top, width, height }) {
  const middle = [left + width / 2, top + height / 2];
  return {
    left, top, width, height, scale, middle: [x, y],
    x: (m) => middle[0] + (m - x) * scale, y: (m) => middle[1] - (m - y) * scale,
    east: (px) => x + (px - middle[0]) / scale, north: (px) => y - (px - middle[1]) / scale,
  };
}

/** The same view for a scene whose home lies elsewhere, [east, north] m away. */
export function moved(view, [east, north]) {
  return { ...view, x: (m) => view.x(m + east), y: (m) => view.y(m + north), east: (px) => view.east(px) - east, north: (px) => view.north(px) - north };
}

/** How far 95% of the belief reaches from the estimate, m. */
export function reach(estimate) {
  return estimate.radius_95_m ?? 1.73 * estimate.spread_m;
}

/** Where a scene's area lies and how long it is, m. */
export function extent({ area: [west, south, east, north] }) {
  const width = east - west, height = north - south;
  return { west, south, east, north, width, height, longer: Math.max(width, height) };
}

/** How far a place is beyond the area's edges, m; 0 or less inside. */
function off({ west, south, east, north }, x, y) {
  return Math.max(west - x, x - east, south - y, y - north);
}

/** How far the estimate or a true source is beyond the area's edges, m. */
function beyond(scene) {
  const area = extent(scene), { estimate, truth } = scene;
  const places = [...(estimate ? [[estimate.x, estimate.y]] : []), ...(truth?.sources ?? [])];
  return Math.min(area.longer, Math.max(0, ...places.map(([x, y]) => off(area, x, y)))); // a record may say absurd things
}

/** The camera of one map. */
export class Camera {
  constructor() {
    this.mode = "all"; // belief, free
    this.at = [0, 0];
    this.scale = 1;
  }

  /** The view of a scene in a window of px; `others`: places {x, y} of what is shown beside it. */
  view(scene, others, width, height) {
    const room = { left: LEFT, top: TOP, width: Math.max(60, width - LEFT - RIGHT), height: Math.max(60, height - TOP - BOTTOM) };
    this.room = room;
    const area = extent(scene);
    this.longer = area.longer;
    if (this.mode === "belief" && !scene.estimate) this.mode = "all";
    if (this.mode === "belief") {
      const side = Math.max(2 * SMALLEST_M, 3 * reach(scene.estimate));
      this.at = [scene.estimate.x, scene.estimate.y];
      this.scale = Math.min(room.width, room.height) / side;
    } else if (this.mode === "all") {
      const edge = Math.max(area.longer * 0.02, 1.5 * beyond(scene));
      let [west, south, east, north] = [area.west - edge, area.south - edge, area.east + edge, area.north + edge];
      for (const craft of [scene.craft, ...others]) {
        if (!isPlaced(craft) || off(area, craft.x, craft.y) > 4 * area.longer) continue;
        [west, south, east, north] = [Math.min(west, craft.x - edge), Math.min(south, craft.y - edge), Math.max(east, craft.x + edge), Math.max(north, craft.y + edge)];
      }
      this.at = [(west + east) / 2, (south + north) / 2];
      this.scale = Math.min(room.width / (east - west), room.height / (north - south));
    }
    return viewOf(this.at, this.scale, room);
  }

  /** Zoom by a factor; what is at a pixel stays there. */
  zoom(view, factor, px = view.left + view.width / 2, py = view.top + view.height / 2) {
    const least = Math.min(view.width, view.height) / (LARGEST * this.longer), most = Math.min(view.width, view.height) / SMALLEST_M;
    const scale = Math.min(most, Math.max(least, this.scale * factor));
    const [x, y] = [view.east(px), view.north(py)], kept = 1 - this.scale / scale;
    this.at = [this.at[0] + (x - this.at[0]) * kept, this.at[1] + (y - this.at[1]) * kept];
    Object.assign(this, { scale, mode: "free" });
  }

  /** Move by pixels. */
  pan(dx, dy) {
    this.at = [this.at[0] - dx / this.scale, this.at[1] + dy / this.scale];
    this.mode = "free";
  }
}

/** Let people move the map: wheel, fingers, mouse and keys. on: {view(), changed(), tell(px, py) or tell(null)}. */
export function followHands(canvas, camera, on) {
  const fingers = new Map();
  const place = (event) => [event.offsetX, event.offsetY];
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(on.view(), Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event));
    on.changed();
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, place(event));
    canvas.setPointerCapture(event.pointerId);
    on.tell(...place(event));
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId), now = place(event);
    if (before) {
      const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      if (other) {
        const far = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]);
        if (far(before) > 0) camera.zoom(on.view(), far(now) / far(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      } else if (now[0] !== before[0] || now[1] !== before[1]) camera.pan(now[0] - before[0], now[1] - before[1]);
      fingers.set(event.pointerId, now);
      on.changed();
    }
    on.tell(...now);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, ({ pointerId }) => fingers.delete(pointerId));
  canvas.addEventListener("pointerleave", () => on.tell(null));
  const step = 60, keys = {
    ArrowLeft: () => camera.pan(step, 0), ArrowRight: () => camera.pan(-step, 0), ArrowUp: () => camera.pan(0, step), ArrowDown: () => camera.pan(0, -step),
    "+": () => camera.zoom(on.view(), 1.3), "=": () => camera.zoom(on.view(), 1.3), "-": () => camera.zoom(on.view(), 1 / 1.3),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey || !on.view()) return;
    event.preventDefault();
    event.stopPropagation(); // elsewhere these keys go through a record
    keys[event.key]();
    on.changed();
  });
}
