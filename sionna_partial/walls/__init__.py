"""Wall cells -> few clean outlines; `outlines` is the way in."""
