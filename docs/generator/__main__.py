"""Write the generated pages: `make generated` after a change of a message, `make docs` for the site."""

from __future__ import annotations

import sys

from . import DOCS, ROOT, committed, reference

files = committed()
if "--site" in sys.argv:
    files |= {DOCS / "reference" / name: text for name, text in reference().items()}
for path, text in files.items():
    path.parent.mkdir(exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)
        sys.stdout.write(f"{path.relative_to(ROOT)}\n")
