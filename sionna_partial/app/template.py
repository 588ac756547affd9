"""The HTML of the page, and the code that runs in the browser."""

UNSELECT = "points.selection_manager.clear()"
"""Ends the selection by a click: otherwise the next drag would move the clicked transmitter as well."""

UPLOAD = "document.getElementById(id).click()"
COPY = """
const copied = navigator.clipboard ? navigator.clipboard.writeText(area.value) : Promise.reject()
copied.then(() => { message.text = "Copied." }, () => { message.text = "Select the lines, and copy them with Ctrl-C." })
"""
LOST = "message.text = 'The connection has ended: start sionna-partial app again, and open the address that it prints.'"

TEMPLATE = """\
{% block title %}Radio coverage{% endblock %}
{% block postamble %}
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
<style>
  html, body { height: 100%; margin: 0 }
  body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #f6f7f8 }
  main { display: grid; grid-template:
    "title status status" 3.6rem "map map controls" minmax(0, 1fr) / 10.5rem minmax(0, 1fr) 21rem;
    gap: 0.6rem 0.8rem; height: 100%; max-width: 120rem; margin: auto; padding: 0.6rem; box-sizing: border-box }
  h1 { font-size: 1.15rem; white-space: nowrap; margin: 0; grid-area: title; align-self: center }
  h2 { font-size: 0.95rem; margin: 0 0 0.4rem }
  section { background: white; border: 1px solid #d5d9de; border-radius: 8px; padding: 0.6rem; box-sizing: border-box }
  #status { grid-area: status; overflow-y: auto; padding: 0.3rem 0.6rem }
  #picture { grid-area: map; display: flex; flex-direction: column; gap: 0.3rem }
  #choices { display: flex; flex-wrap: wrap; gap: 0 0.6rem } #choices > div { flex: 1 1 19rem }
  #plot { flex: 1 1 0; min-height: 16rem }
  #summary { height: 3rem; overflow-y: auto } #files { height: 2.4rem; overflow: auto hidden; white-space: nowrap }
  #controls { grid-area: controls; overflow-y: auto } #controls section { margin-bottom: 0.6rem }
  @media (max-width: 52rem) {
    main { display: block; height: auto; padding: 0.4rem } main > * { margin-bottom: 0.4rem }
    #status { height: 4.6rem } #plot { flex: none; height: min(110vw, 70vh) } #controls { overflow: visible }
    #summary { height: 6.2rem } #files { height: auto; white-space: normal }
  }
</style>
{% endblock %}
{% block contents %}
<main>
  <h1>Radio coverage</h1>
  <section id="status" aria-label="Status">{{ embed(roots.status) }}</section>
  <section id="picture" aria-label="Map with transmitters and coverage">
    <div id="choices"><div>{{ embed(roots.layers) }}</div><div>{{ embed(roots.choices) }}</div></div>
    <div id="plot">{{ embed(roots.picture) }}</div>
    <div id="summary">{{ embed(roots.summary) }}</div>
    <div id="files" role="group" aria-label="Downloads">{{ embed(roots.links) }}</div>
  </section>
  <div id="controls">
    <section aria-labelledby="map"><h2 id="map">Map</h2>{{ embed(roots.map) }}</section>
    <section aria-labelledby="tx"><h2 id="tx">Transmitters</h2>{{ embed(roots.transmitters) }}</section>
    <section aria-labelledby="radio"><h2 id="radio">Radio and walls</h2>{{ embed(roots.radio) }}</section>
    <section aria-labelledby="robot"><h2 id="robot">Robot and measurements</h2>{{ embed(roots.robot) }}</section>
    <section aria-labelledby="repeat"><h2 id="repeat">Repeat</h2>{{ embed(roots.repeat) }}</section>
  </div>
</main>
<input type="file" id="map-file" multiple hidden accept="{{ map_suffixes }}" aria-label="Map files">
<input type="file" id="csv-file" hidden accept=".csv" aria-label="Measurements">
<script>
  try { // a pause before a drag is no long press, which no tool here takes
    Bokeh.require("core/ui_gestures").UIGestures.press_threshold = 2 ** 30
  } catch { console.info("A drag begins within 0.3 s.") }
  const labels = {
    "noUi-handle": "Threshold [dBm]", "bk-spin-btn-up": "more", "bk-spin-btn-down": "less",
    "bk-events": "Map; the fields x and y move its transmitters",
  }
  document.addEventListener("focusin", event => {
    const node = event.composedPath()[0]
    const name = Object.keys(labels).find(each => node.classList?.contains(each))
    if (name || node.title) node.setAttribute("aria-label", labels[name] ?? node.title)
    if (name == "bk-events") node.setAttribute("role", "img")
    else if (node.tagName == "DIV" && node.title) node.setAttribute("role", "button")
  })
  for (const [id, kind] of [["map-file", "map"], ["csv-file", "measurements"]]) {
    const input = document.getElementById(id)
    input.onchange = async () => {
      const form = new FormData()
      let size = 0
      for (const file of input.files) { form.append("file", file); size += file.size }
      input.value = ""
      if (size > {{ most_bytes }}) return alert("Too large: start sionna-partial app with the map's path.")
      try {
        const answer = await fetch("{{ files_url }}/" + kind, { method: "POST", body: form })
        if (!answer.ok) alert(await answer.text())
      } catch { alert("The file was not sent: start sionna-partial app again, and open the address that it prints.") }
    }
  }
</script>
{% endblock %}
"""
