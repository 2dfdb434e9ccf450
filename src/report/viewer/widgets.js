// Elements of the page.

/// Creates an element; attributes with a dash, `class`, `role` and `for` are set as such, all others
/// as properties.
export function make(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (/-|^class$|^role$|^for$/.test(key)) made.setAttribute(key, value);
    else made[key] = value;
  }
  made.append(...children);
  return made;
}
