"""Who may speak to a viewer: the page that it serves itself, and nobody else.

Any page that a browser shows can open a websocket to this machine, and a name of its own can be made to point here; the
browser says of both where they come from. So ``Host`` has to be this machine, by whatever port (a tunnel may lead
here), and ``Origin`` the same. A websocket has to name its origin: every browser does; programs of this machine, which
could read and write the user's files themselves, may state it. The page is told to connect to nobody else either, for
an address with ``?websocket=`` would let another server run scripts in it, and to be framed by this machine's pages
only.
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

from magloc.viewer.panels.lines import POINTED
from magloc.viewer.panels.readings_plot import AT
from magloc.viewer.scene.legend import FOLLOWS_THE_SCHEME

NAMES = ("127.0.0.1", "localhost")
MOST_BYTES = 2**20  # of a message: a page sends what was typed, dragged or clicked
_one_at_a_time = threading.Lock()


def comes_from_outside(headers: Headers) -> bool:
    """Whether a request is that of another page than the viewer's own, by its Host and Origin."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or hosts[0].partition(":")[0] not in NAMES:
        return True
    may_be_silent = not headers.get_all("Upgrade")  # a page that is opened by its address has no origin
    return origins != [f"http://{hosts[0]}"] and not (may_be_silent and not origins)


SMOOTH = "?smooth"
"""Asked for by a page that is to be a picture, which may take its time."""
# Without a graphics card the smoothing of edges is half of the work of a picture: a page that moves does without.
_QUICK_IN_SOFTWARE = f"""<script>
if (location.search !== '{SMOOTH}') {{
  const plain = HTMLCanvasElement.prototype.getContext;
  const probe = plain.call(document.createElement('canvas'), 'webgl');
  const named = probe && probe.getExtension('WEBGL_debug_renderer_info');
  if (named && /swiftshader|llvmpipe|software/i.test(probe.getParameter(named.UNMASKED_RENDERER_WEBGL)))
    HTMLCanvasElement.prototype.getContext = function (kind, options) {{
      return plain.call(this, kind, kind.startsWith('webgl') ? {{...options, antialias: false}} : options);
    }};
}}
</script>"""
# Until it has connected, viser's page says that it is inactive, as if nothing were to come. On a phone its panel lies
# over the scene, and is folded at first by a click on its title: the server's word to fold it reaches wider pages only.
# Where a plot is pointed at, the time of it is typed into its input.
_ADDED = f"""<style>.tabler-icon-player-pause {{ display: none; }}</style>
<script>
let isToFold = matchMedia('(max-width: 36em)').matches;
const waiting = setInterval(() => {{
  const title = isToFold && document.querySelector('[style*="cursor: pointer"][style*="height: 3.5em"]');
  if (title) {{ title.click(); isToFold = false; }}
  const said = document.evaluate("//text()[. = 'Inactive']", document, null, 6, null);
  for (let i = 0; i < said.snapshotLength; i++) said.snapshotItem(i).data = "Connecting…";
}}, 30);
setTimeout(() => clearInterval(waiting), 60000);
(() => {{
  {POINTED}
  whenPointed(document, (plot, event) => {{
    const label = [...document.querySelectorAll('label[for]')].find(found => found.innerText === '{AT}');
    const input = label && document.getElementById(label.htmlFor);
    if (input) typeInto(input, timeOf(plot, event).toFixed(3));
  }});
}})();
</script>
""".encode()


def _say_what_it_waits_for(page: Response) -> None:
    """Let a page of viser say that it is connecting, fold its panel on a phone, and be dark where the browser is."""
    page.body = _with_words(bytes(page.body), page.headers.get("Content-Encoding") == "gzip")
    del page.headers["Content-Length"]
    page.headers["Content-Length"] = str(len(page.body))


@lru_cache(maxsize=4)
def _with_words(body: bytes, compressed: bool) -> bytes:
    page = gzip.decompress(body) if compressed else body
    page = page.replace(b"<head>", b"<head>" + (FOLLOWS_THE_SCHEME + _QUICK_IN_SOFTWARE).encode(), 1) + _ADDED
    return gzip.compress(page) if compressed else page


def guarded_server(**options: Any) -> viser.ViserServer:
    """A server of viser that answers its own page only, whatever asks.

    viser has no hook for it: its call of websockets' ``serve``, in a thread of its own, is met while it starts.
    """
    plain, met = websockets_server.serve, threading.Event()

    def serve(handler: Any, *arguments: Any, process_request: Any = None, **others: Any) -> Any:
        if not handler.__module__.startswith("viser."):
            return plain(handler, *arguments, process_request=process_request, **others)

        def checked(connection: ServerConnection, request: Request) -> Response | None:
            if comes_from_outside(request.headers):
                return connection.respond(HTTPStatus.FORBIDDEN, "Only the viewer's own page is answered.\n")
            reply: Response | None = process_request(connection, request)
            if reply is not None:
                if reply.headers.get("Content-Type", "").startswith("text/html"):
                    _say_what_it_waits_for(reply)
                reply.headers["Content-Security-Policy"] = (
                    f"connect-src 'self' ws://{request.headers['Host']} data: blob:; "
                    f"frame-ancestors 'self' {' '.join(f'http://{name}:*' for name in NAMES)}"
                )
            return reply

        met.set()
        return plain(handler, *arguments, process_request=checked, **{**others, "max_size": MOST_BYTES})

    with _one_at_a_time:
        websockets_server.serve = serve  # type: ignore[assignment, misc]
        try:
            server = viser.ViserServer(**options)
        finally:
            websockets_server.serve = plain  # type: ignore[misc]
    if not met.is_set():
        server.stop()
        raise RuntimeError(f"This version of viser ({viser.__version__}) starts its server in a way that is not known.")
    return server
