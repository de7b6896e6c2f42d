"""Protection of a viewer's server: it answers its own page only.

Any page in a browser can open a websocket to this machine, and any host name can be made to point here. The browser
states the origin of both. Therefore ``Host`` has to be this machine, at any port (a tunnel may lead here), and
``Origin`` has to equal it. A websocket must state its origin, as every browser does; local programs, which have the
user's rights anyway, may state it too. A security policy forbids the page to connect elsewhere, because an address with
``?websocket=`` would let another server run scripts in it. Only pages of this machine may embed the page.
"""

from __future__ import annotations

import gzip
import threading
from functools import lru_cache
from http import HTTPStatus
from typing import Any

import viser
import websockets.asyncio.server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from magloc.viewer.panels.lines import POINTER_SCRIPT
from magloc.viewer.panels.readings_plot import AT
from magloc.viewer.scene.legend import SCHEME_SCRIPT

NAMES = ("127.0.0.1", "localhost")
MOST_BYTES = 2**20  # of a message: a page sends only inputs of the user
_lock = threading.Lock()


def is_foreign(headers: Headers) -> bool:
    """Return whether Host and Origin of a request are not those of the viewer's own page."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or hosts[0].partition(":")[0] not in NAMES:
        return True
    is_page = not headers.get_all("Upgrade")  # the request of a typed address has no origin
    return origins != [f"http://{hosts[0]}"] and not (is_page and not origins)


SMOOTH = "?smooth"
"""Query of the address of a page for pictures, which has smooth edges on every machine."""
# Without a graphics card, smoothing of edges takes half of the time of a frame: an interactive page omits it.
_NO_SMOOTHING_SCRIPT = f"""<script>
if (location.search !== '{SMOOTH}') {{
  const original = HTMLCanvasElement.prototype.getContext;
  const probe = original.call(document.createElement('canvas'), 'webgl');
  const info = probe && probe.getExtension('WEBGL_debug_renderer_info');
  if (info && /swiftshader|llvmpipe|software/i.test(probe.getParameter(info.UNMASKED_RENDERER_WEBGL)))
    HTMLCanvasElement.prototype.getContext = function (kind, options) {{
      return original.call(this, kind, kind.startsWith('webgl') ? {{...options, antialias: false}} : options);
    }};
}}
</script>"""
# Until it has connected, viser's page says that it is inactive: the script writes "Connecting…" instead. On a phone the
# panel covers the scene: the script folds it by a click on its title, because the server can fold it on wider pages
# only. A press on a plot writes the time of that place into the input of the time.
_PAGE_SCRIPT = f"""<style>.tabler-icon-player-pause {{ display: none; }}</style>
<script>
let mustFold = matchMedia('(max-width: 36em)').matches;
const timer = setInterval(() => {{
  const title = mustFold && document.querySelector('[style*="cursor: pointer"][style*="height: 3.5em"]');
  if (title) {{ title.click(); mustFold = false; }}
  const texts = document.evaluate("//text()[. = 'Inactive']", document, null, 6, null);
  for (let i = 0; i < texts.snapshotLength; i++) texts.snapshotItem(i).data = "Connecting…";
}}, 30);
setTimeout(() => clearInterval(timer), 60000);
(() => {{
  {POINTER_SCRIPT}
  onPlotPointer(document, (plot, event) => {{
    const label = [...document.querySelectorAll('label[for]')].find(each => each.innerText === '{AT}');
    const input = label && document.getElementById(label.htmlFor);
    if (input) setInput(input, plotTime(plot, event).toFixed(3));
  }});
}})();
</script>
""".encode()


def _adapt_page(page: Response) -> None:
    """Add the scripts for connection, phones, dark scheme and plots to a page of viser."""
    page.body = _with_scripts(bytes(page.body), page.headers.get("Content-Encoding") == "gzip")
    del page.headers["Content-Length"]
    page.headers["Content-Length"] = str(len(page.body))


@lru_cache(maxsize=4)
def _with_scripts(body: bytes, is_compressed: bool) -> bytes:
    page = gzip.decompress(body) if is_compressed else body
    page = page.replace(b"<head>", b"<head>" + (SCHEME_SCRIPT + _NO_SMOOTHING_SCRIPT).encode(), 1) + _PAGE_SCRIPT
    return gzip.compress(page) if is_compressed else page


def start_guarded_server(**options: Any) -> viser.ViserServer:
    """Start a server of viser that answers its own page only.

    viser has no hook for this. Therefore its call of ``serve`` of websockets, in another thread, is intercepted.
    """
    original, is_intercepted = websockets_server.serve, threading.Event()

    def serve(handler: Any, *arguments: Any, process_request: Any = None, **others: Any) -> Any:
        if not handler.__module__.startswith("viser."):
            return original(handler, *arguments, process_request=process_request, **others)

        def process_guarded(connection: ServerConnection, request: Request) -> Response | None:
            if is_foreign(request.headers):
                return connection.respond(HTTPStatus.FORBIDDEN, "Only the viewer's own page is answered.\n")
            reply: Response | None = process_request(connection, request)
            if reply is not None:
                if reply.headers.get("Content-Type", "").startswith("text/html"):
                    _adapt_page(reply)
                reply.headers["Content-Security-Policy"] = (
                    f"connect-src 'self' ws://{request.headers['Host']} data: blob:; "
                    f"frame-ancestors 'self' {' '.join(f'http://{name}:*' for name in NAMES)}"
                )
            return reply

        is_intercepted.set()
        return original(handler, *arguments, process_request=process_guarded, **{**others, "max_size": MOST_BYTES})

    with _lock:
        websockets_server.serve = serve  # type: ignore[assignment, misc]
        try:
            server = viser.ViserServer(**options)
        finally:
            websockets_server.serve = original  # type: ignore[misc]
    if not is_intercepted.is_set():
        server.stop()
        raise RuntimeError(
            f"Found viser {viser.__version__}, which starts its server in an unknown way, expected an older version."
        )
    return server
