"""The app: a page in the browser on which transmitters are dragged over a map and the coverage follows."""
