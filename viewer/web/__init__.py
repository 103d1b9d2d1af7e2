"""The viewer in a browser: a page that draws, and a small server that only answers what it is asked for."""
