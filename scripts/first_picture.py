#!/usr/bin/env python3
"""How long it takes from `loomtree run SCENE --view` to the first picture of the cloth in a browser that is open.

    scripts/first_picture.py [SCENE [PROGRAM]]      scenes/flag.toml with target/release/loomtree

Prints seconds since the start of the program, and the load of the machine: until the address is printed, until the page
has the first frame, and until that frame has been drawn and the picture shown (headless Chromium with its software
renderer). Saves what is seen then as out/first_picture.png. Needs `chromium` in PATH.
"""
import base64
import os
import signal
import subprocess
import sys
import tempfile
import time

sys.dont_write_bytecode = True
from page_rate import Browser  # noqa: E402: after the line above

LIMIT_S = 60
SHOWN = "Boolean(globalThis.loomtree?.shown?.some((shown) => shown.frame))"
DRAWN = "new Promise((seen) => requestAnimationFrame(() => requestAnimationFrame(() => seen(true))))"


def main():
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    scene = sys.argv[1] if len(sys.argv) > 1 else os.path.join(root, "scenes/flag.toml")
    program = sys.argv[2] if len(sys.argv) > 2 else os.path.join(root, "target/release/loomtree")
    browser = Browser(960, 720)
    browser.call("Page.enable")
    with tempfile.TemporaryDirectory(prefix="first-picture-") as folder:
        print("load", " ".join(f"{load:.2f}" for load in os.getloadavg()))
        start = time.monotonic()
        run = subprocess.Popen([program, "run", scene, "--view", "--out", os.path.join(folder, "run")],
                               stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        try:
            address = run.stdout.readline().strip()
            print(f"address printed    {time.monotonic() - start:.2f} s")
            browser.call("Page.navigate", url=address)
            while not browser.value(SHOWN):
                if time.monotonic() - start > LIMIT_S or run.poll() is not None:
                    sys.exit("no frame in the page")
                time.sleep(0.01)
            print(f"frame in the page  {time.monotonic() - start:.2f} s")
            browser.call("Runtime.evaluate", expression=DRAWN, awaitPromise=True)
            print(f"picture shown      {time.monotonic() - start:.2f} s")
            picture = browser.call("Page.captureScreenshot")["data"]
            os.makedirs("out", exist_ok=True)
            with open("out/first_picture.png", "wb") as file:
                file.write(base64.b64decode(picture))
        finally:
            run.send_signal(signal.SIGINT)
            run.wait()
            browser.close()


if __name__ == "__main__":
    main()
