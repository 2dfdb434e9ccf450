"""Observers of long work."""

import logging

_log = logging.getLogger("splatvk")


def log(event):
    """Warnings and information to the logger `splatvk`, stages at level DEBUG."""
    if event.kind == "warning":
        _log.warning(event.text)
    elif event.kind == "info":
        _log.info(event.text)
    elif event.kind == "begin":
        _log.debug("%s begins", event.stage)


class Bar:
    """A tqdm bar per stage; without tqdm, a log line per stage."""

    def __init__(self):
        try:
            from tqdm.auto import tqdm
        except ImportError:
            tqdm = None
        self._tqdm = tqdm
        self._bar = None
        self._number = None

    def __call__(self, event):
        log(event)
        if event.kind == "overall":
            self._number = event.number
        elif event.kind == "begin":
            self._begin(event)
        elif event.kind == "step" and self._bar is not None:
            self._bar.update(event.done - self._bar.n)
            if event.text:
                self._bar.set_postfix_str(event.text, refresh=False)
        elif event.kind == "end":
            self.close()

    def _begin(self, event):
        self.close()
        place = f"{self._number[0]}/{self._number[1]} " if self._number else ""
        if self._tqdm is None:
            _log.info("%s%s", place, event.stage)
        else:
            self._bar = self._tqdm(desc=place + event.stage, total=event.total or None, leave=False)

    def close(self):
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def observer(progress):
    """The observer that an argument `progress` means."""
    if callable(progress):
        return progress
    return Bar() if progress else log
