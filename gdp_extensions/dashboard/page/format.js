// Texts for figures, and elements without markup in strings: every label comes from another process.

const UNITS = ["", "k", "M", "G", "T"];

export function scaled(value, unit) {
  let at = 0;
  while (Math.abs(value) >= 1000 && at < UNITS.length - 1) {
    value /= 1000;
    at += 1;
  }
  const digits = value >= 100 || (at === 0 && Number.isInteger(value)) ? 0 : value >= 10 ? 1 : 2;
  return `${value.toFixed(digits)} ${UNITS[at]}${unit}`;
}

export const bits = (bytes) => scaled(8 * bytes, "bit/s");
export const perSecond = (rate) => `${rate >= 100 ? rate.toFixed(0) : rate >= 10 ? rate.toFixed(1) : rate.toFixed(2)}/s`;
export const millis = (ms) => (ms === null || ms === undefined ? "–" : `${ms < 10 ? ms.toFixed(2) : ms.toFixed(1)} ms`);
export const count = (value) => Math.round(value).toLocaleString("en");
export const clock = (unix) => new Date(unix * 1000).toTimeString().slice(0, 8);

export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "onclick") made.addEventListener("click", value);
    else if (value !== false && value !== undefined) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((each) => each !== null));
  return made;
}
