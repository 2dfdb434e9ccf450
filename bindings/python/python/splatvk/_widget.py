"""The interactive view in notebooks."""

import html as _html
import json

import numpy as np

# As many as in a report: fewer tear holes. About 7 MB in the notebook.
MOST = 300_000


def html(scene):
    """The view as a frame, for `_repr_html_`."""
    page = _html.escape(scene._page(MOST, False), quote=True)
    return f'<iframe srcdoc="{page}" style="width:100%;height:480px;border:0" loading="lazy"></iframe>'


# The frame and this module talk by messages; the model carries them to Python.
_MODULE = """
function render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.style = `width:100%;height:${model.get("height")}px;border:0`;
  frame.srcdoc = model.get("page");
  const hear = ({ source, data }) => {
    const message = source === frame.contentWindow && data?.splatvk;
    if (!message) return;
    if (message.ask !== undefined) return model.send(message);
    model.set("selection", message);
    model.save_changes();
  };
  const answer = (message) => frame.contentWindow?.postMessage({ splatvk: message }, "*");
  window.addEventListener("message", hear);
  model.on("msg:custom", answer);
  el.append(frame);
  return () => {
    window.removeEventListener("message", hear);
    model.off("msg:custom", answer);
  };
}
export default { render };
"""


def make(scene, height):
    """The view as a widget: `selection` is the last choice in it, `mask` its splats."""
    import anywidget
    import traitlets

    from .errors import Error

    class SceneWidget(anywidget.AnyWidget):
        _esm = _MODULE
        page = traitlets.Unicode().tag(sync=True)
        height = traitlets.Int().tag(sync=True)
        selection = traitlets.Dict().tag(sync=True)

        @property
        def scene(self):
            return scene

        @property
        def text(self):
            """The text that was asked last, if its answer is selected."""
            return self.selection.get("text")

        @property
        def mask(self):
            """(N,) bool, the selected splats; `scene[widget.mask]` is a scene of them."""
            chosen = self.selection.get("selected")
            if not chosen:
                return np.zeros(len(scene), bool)
            masks = scene.codes.shape[1]
            codes = scene.codes[:, chosen["level"]] if chosen["level"] < masks else scene.things
            return np.isin(codes, chosen["codes"])

    def hear(widget, message, _buffers):
        number = message.get("number")
        try:
            body, ok = json.loads(scene._ask(str(message.get("ask", "")))), True
        except Error as error:
            body, ok = {"error": str(error)}, False
        widget.send({"number": number, "ok": ok, "body": body})

    widget = SceneWidget(page=scene._page(MOST, scene.has_language), height=height)
    widget.on_msg(hear)
    return widget
