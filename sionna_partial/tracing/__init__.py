"""Map -> scene -> paths; `scene` writes scenes, `trace` is the one door to the path solver."""
