#!/usr/bin/env python3
"""Pictures per second of the page of `loomtree view` in headless Chromium with its software renderer.

    loomtree view out/flag            # prints ADDRESS
    scripts/page_rate.py ADDRESS [WIDTH HEIGHT]

Turns the camera for ten seconds, then plays the run at twice its speed, each with and without shadows. Prints pictures
per second, the processor time of a picture over all processes of the browser, and the size of the canvas (the page
lowers it while things move and a picture takes longer than 45 ms). Needs `chromium` in PATH.
"""
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time

SECONDS = 10
TICKS = os.sysconf("SC_CLK_TCK")
COUNT = """window.pictures = 0; const draw = loomtree.renderer.draw.bind(loomtree.renderer);
loomtree.renderer.draw = (...a) => { window.pictures++; draw(...a); }; 1"""
TURN = """window.turn = () => { if (!window.turns) return; loomtree.touched = true; loomtree.camera.orbit(3, 0);
loomtree.moving = performance.now(); loomtree.dirty = true; requestAnimationFrame(turn); }; window.turns = true; turn(); 1"""
PLAY = "window.turns = false; loomtree.speed = 2; loomtree.play(true); 1"


class Browser:
    """Chromium over its DevTools protocol: JSON with a zero byte at the end, on descriptors 3 and 4."""

    def __init__(self, width, height):
        self.folder = tempfile.mkdtemp(prefix="page-rate-")
        (theirs_in, self.to), (self.source, theirs_out) = os.pipe(), os.pipe()

        def pipes():
            high = [os.dup2(theirs_in, 203), os.dup2(theirs_out, 204)]
            os.dup2(high[0], 3)
            os.dup2(high[1], 4)

        self.process = subprocess.Popen(
            ["chromium", "--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--use-angle=swiftshader",
             "--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--no-first-run", f"--user-data-dir={self.folder}"],
            close_fds=False, preexec_fn=pipes, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(theirs_in)
        os.close(theirs_out)
        self.calls, self.text, self.session = 0, b"", None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def call(self, method, **parameters):
        self.calls += 1
        message = {"id": self.calls, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.text:
                piece = os.read(self.source, 1 << 20)
                if not piece:
                    sys.exit("the browser has ended")
                self.text += piece
            answer, self.text = self.text.split(b"\0", 1)
            answer = json.loads(answer)
            if answer.get("id") == self.calls:
                return answer["result"]

    def value(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return result["result"].get("value")

    def close(self):
        self.call("Browser.close")
        self.process.wait(10)
        shutil.rmtree(self.folder, ignore_errors=True)

    def processor_s(self):
        """Of all processes below the browser."""
        ticks, parents = {}, {}
        for name in filter(str.isdigit, os.listdir("/proc")):
            try:
                fields = open(f"/proc/{name}/stat").read().rsplit(")", 1)[1].split()
            except OSError:
                continue
            parents[int(name)], ticks[int(name)] = int(fields[1]), int(fields[11]) + int(fields[12])

        def below(pid):
            while pid in parents and pid != self.process.pid:
                pid = parents[pid]
            return pid == self.process.pid

        return sum(t for pid, t in ticks.items() if below(pid)) / TICKS


def main():
    if len(sys.argv) not in (2, 4) or not shutil.which("chromium"):
        sys.exit(__doc__)
    width, height = map(int, sys.argv[2:4] or (1280, 800))
    browser = Browser(width, height)
    browser.call("Page.navigate", url=sys.argv[1])
    while not browser.value("window.loomtree && loomtree.shown.every((s) => s.frame !== null)"):
        time.sleep(0.1)
    browser.value(COUNT)
    print("load before:", open("/proc/loadavg").read().split()[0])
    for what, script in (("turn", TURN), ("play", PLAY)):
        for shadows in ("true", "false"):
            browser.value(script)
            browser.value(f"loomtree.setOption('shadows', {shadows})")
            time.sleep(3)
            before, drawn, begin = browser.processor_s(), browser.value("window.pictures"), time.time()
            time.sleep(SECONDS)
            pictures, seconds = browser.value("window.pictures") - drawn, time.time() - begin
            used = browser.processor_s() - before
            size = browser.value("`${loomtree.renderer.canvas.width} x ${loomtree.renderer.canvas.height}`")
            print(f"{what}, shadows {shadows}: {pictures / seconds:.1f} pictures/s, "
                  f"{1e3 * used / max(1, pictures):.0f} ms of processor each, canvas {size}")
    browser.close()


if __name__ == "__main__":
    main()
