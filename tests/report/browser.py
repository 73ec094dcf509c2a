"""Headless Chromium, spoken to through a pipe: what a reader of a page would see."""

import base64
import fcntl
import json
import os
import shutil
import subprocess

NAME = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# Widths in px: a telephone, a screen, and A4 less the margins of the page.
WIDTHS = {"phone": 400, "screen": 1280, "print": 673}
OPEN = "document.querySelectorAll('details').forEach(folded => folded.open = true)"
SEEN = """JSON.stringify({
  wide: document.documentElement.scrollWidth - document.documentElement.clientWidth,
  cut: [...document.querySelectorAll(".wide")].some(e => e.scrollWidth > e.clientWidth + 1),
  pictures: [...document.images].map(i => i.naturalWidth > 0 && i.clientWidth > 150)
})"""


class Chromium:
    """A browser with one page, which notes requests, errors and what was written to its console."""

    def __init__(self, folder):
        read, self.out = os.pipe()
        self.into, write = os.pipe()
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (read, write)]
        flags = "--headless --no-sandbox --disable-gpu --remote-debugging-pipe"
        command = f"exec {NAME} {flags} --user-data-dir={folder} 3<&{ends[0]} 4>&{ends[1]}"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen(["bash", "-c", command], pass_fds=ends, **quiet)
        for end in (read, write, *ends):
            os.close(end)
        self.rest, self.events, self.number, self.session = b"", [], 0, {}
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        found = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self.session = {"sessionId": found["sessionId"]}
        for part in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{part}.enable")

    def _message(self):
        while b"\0" not in self.rest:
            more = os.read(self.into, 1 << 16)
            assert more, "Chromium ended"
            self.rest += more
        message, _, self.rest = self.rest.partition(b"\0")
        return json.loads(message)

    def ask(self, method, **told):
        self.number += 1
        said = {"id": self.number, "method": method, "params": told} | self.session
        os.write(self.out, json.dumps(said).encode() + b"\0")
        while (answer := self._message()).get("id") != self.number:
            self.events.append(answer)
        return answer["result"]

    def _open(self, page):
        self.ask("Page.navigate", url=page.as_uri())
        while not any(e["method"] == "Page.loadEventFired" for e in self.events):
            self.events.append(self._message())

    def screen(self, page):
        """The first screen of a page, 1280 by 800, as PNG; `foot` of it is then known."""
        self.events.clear()
        size = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **size)
        self._open(page)
        return base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])

    def foot(self):
        """Height in px, from the top, at which the numbers that people quote end."""
        rule = "document.querySelector('.first').getBoundingClientRect().bottom"
        return self.ask("Runtime.evaluate", expression=rule)["result"]["value"]

    def faults(self, page, width, pictures):
        """What is wrong with a page of so many pictures at a width, in words."""
        self.events.clear()
        size = {"width": WIDTHS[width], "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **size)
        self.ask("Emulation.setEmulatedMedia", media="print" if width == "print" else "screen")
        self._open(page)
        self.ask("Runtime.evaluate", expression=OPEN)
        seen = json.loads(self.ask("Runtime.evaluate", expression=SEEN)["result"]["value"])
        found = [f"{seen['wide']} px to scroll sideways"] * (seen["wide"] > 0)
        found += ["a table is cut off"] * (seen["cut"] and width != "phone")
        there = sum(seen["pictures"])
        found += [f"{there} of {pictures} pictures"] * (there != pictures)
        for event in self.events:
            match event["method"]:
                case "Network.requestWillBeSent":
                    url = event["params"]["request"]["url"]
                    found += [f"asked for {url}"] * (not url.startswith((page.as_uri(), "data:")))
                case "Runtime.consoleAPICalled" | "Runtime.exceptionThrown" | "Log.entryAdded":
                    found.append(f"console: {event['params']}")
        return [f"{page.name} ({width}): {words}" for words in found]

    def printed(self):
        """The page that was looked at as Chromium prints it, a PDF."""
        return base64.b64decode(self.ask("Page.printToPDF", preferCSSPageSize=True)["data"])

    def close(self):
        self.session = {}
        self.ask("Browser.close")
        self.process.wait(20)
        os.close(self.out)
        os.close(self.into)
