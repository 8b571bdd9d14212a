"""A page in a headless Chromium, and the result of a script in it."""

import html
import json
import re
import shutil
import subprocess

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
OUTER = """<!doctype html><body style="margin:0"><iframe src="{src}" width="{width}" height="900" style="border:0"></iframe>
<iframe hidden></iframe><script>
const [shown, open] = document.querySelectorAll("iframe"), held = open.contentDocument;
held.open();  // while it is, this page is not loaded, and its contents are not dumped
shown.onload = async () => {{
  const view = shown.contentWindow, page = view.document;
  const press = (key) => page.dispatchEvent(new view.KeyboardEvent("keydown", {{ key, bubbles: true }}));
  const text = (place) => page.querySelector(place).textContent;
  let said;
  try {{ said = await (async () => {{ {script} }})(); }} catch (error) {{ said = String(error); }}
  document.body.append(Object.assign(document.createElement("pre"), {{ id: "said", textContent: JSON.stringify(said) }}));
  held.close();
}};
</script>"""


def find_browser():
    """The browser's program; None if there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def ask(path, script, width=1280, more=("--disable-gpu",)):
    """The result of a script that runs beside the page; the script has ``view``, ``page``, ``press(key)`` and ``text(selector)``."""
    outer = path.with_name(f"outer-{path.name}")
    outer.write_text(OUTER.format(src=path.resolve().as_uri(), width=width, script=script))
    options = ("--headless=new", "--no-sandbox", *more, "--allow-file-access-from-files")
    command = [find_browser(), *options, f"--user-data-dir={path.parent / 'profile'}", "--dump-dom", outer.as_uri()]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    result = re.search(r'<pre id="said">(.*?)</pre>', process.stdout, re.DOTALL)
    assert result, process.stderr
    return json.loads(html.unescape(result[1]))
