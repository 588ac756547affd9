import logging
said = []
handler = logging.Handler()
handler.emit = said.append
logging.getLogger("sionna_partial").addHandler(handler)
for settings in (dict(trace_settings=sp.TraceSettings(max_depth=1)), dict(scene_settings=sp.SceneSettings(material=sp.Material(itu="metal")))):
    said.clear()
    sp.predict_map(room(), TX, spacing_m=1.0, predictor="paper", **settings)
    if not said:
        raise Wrong(f"no warning for {settings}")
logging.getLogger("sionna_partial").removeHandler(handler)
