// A picture of people's own beneath the map. It stays in the browser: nothing is sent.

import { extent } from "./view.js";

/** Ask for a picture and its place with a dialog; returns ask(map), which puts it under a map. */
export function followPicture(dialog, changed) {
  let asked = null;
  const field = (name) => dialog.querySelector(`[name="${name}"]`);
  dialog.addEventListener("close", async () => {
    const map = asked, file = field("file").files[0];
    if (dialog.returnValue === "none" && map) map.picture = null;
    if (dialog.returnValue === "yes" && map && file) {
      const [west, south, width] = ["west", "south", "width"].map((name) => Number(field(name).value));
      const image = await createImageBitmap(file).catch(() => null);
      if (image && width > 0) map.picture = { image, west, south, width, height: (width * image.height) / image.width };
    }
    changed();
  });
  return (map) => {
    asked = map;
    dialog.returnValue = "";
    if (map.model?.scene) {
      const area = extent(map.model.scene);
      for (const name of ["west", "south", "width"]) field(name).value ||= area[name];
    }
    dialog.showModal();
  };
}
