// Colours of the style sheet, for canvases.

const COLOURS = [
  "ground",
  "road",
  "centreline",
  "ink",
  "muted",
  "panel",
  "ego",
  "adversary",
  "traffic",
  "replayed",
  "vulnerable",
  "driver",
  "evasion",
  "recorded",
  "contact",
];

function readPalette() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Call `redraw` whenever the colours change: another scheme, or printing, which is always light. */
function onPaletteChange(redraw) {
  const printing = (on) => {
    document.documentElement.classList.toggle("printing", on);
    redraw();
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  addEventListener("beforeprint", () => printing(true));
  addEventListener("afterprint", () => printing(false));
}
