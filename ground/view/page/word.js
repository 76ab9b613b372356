// The word that allows commands: asked of people, kept until the window is closed, and said in a header, so that no address holds it.

const KEY = "plumeward-word", AGAIN_MS = 1100;

/** The subprotocols of a connection: the page's own, and the word if there is one. */
export function offered() {
  const word = sessionStorage.getItem(KEY);
  if (!word) return ["plumeward"];
  const coded = btoa(String.fromCharCode(...new TextEncoder().encode(word)));
  return ["plumeward", `word.${coded.replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "")}`];
}

/** Ask for the word with a button and a dialog, and connect `again` with it. Returns what to do with the server's answer to the word. */
export function followWord(button, dialog, again) {
  const field = dialog.querySelector("input");
  button.addEventListener("click", () => {
    field.value = dialog.returnValue = "";
    dialog.showModal();
  });
  dialog.addEventListener("close", () => {
    if (dialog.returnValue !== "yes" || !field.value) return;
    sessionStorage.setItem(KEY, field.value.trim());
    field.value = "";
    again();
  });
  return (answer) => {
    button.hidden = !answer;
    if (answer === "wrong") sessionStorage.removeItem(KEY);
    if (answer === "later") setTimeout(again, AGAIN_MS);
  };
}
