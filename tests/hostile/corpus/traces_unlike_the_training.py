import warnings
for settings in (dict(trace_settings=sp.TraceSettings(max_depth=1)), dict(scene_settings=sp.SceneSettings(material=sp.Material(itu="metal")))):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sp.predict_map(room(), TX, spacing_m=1.0, predictor="paper", **settings)
    if not caught:
        raise Wrong(f"no warning for {settings}")
