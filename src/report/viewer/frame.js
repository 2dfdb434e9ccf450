// Talk of a framed view with the page around it, such as a notebook: selections go out, questions
// go out and come back with their number.

const waiting = new Map();
let number = 0;

/// Sends a message to the outer page. A frame of `srcdoc` has no origin of its own to name.
export function tellOuter(message) {
  if (window.parent !== window) window.parent.postMessage({ splatvk: message }, "*");
}

/// Asks the outer page; resolves to {ok, body} as a server answers.
export function askOuter(text) {
  return new Promise((resolve) => {
    waiting.set(++number, resolve);
    tellOuter({ ask: text, number });
  });
}

window.addEventListener("message", ({ source, data }) => {
  const answer = source === window.parent && data?.splatvk;
  if (!answer || !waiting.has(answer.number)) return;
  waiting.get(answer.number)({ ok: answer.ok, body: answer.body });
  waiting.delete(answer.number);
});
