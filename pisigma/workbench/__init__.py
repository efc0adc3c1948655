"""Pages in the browser for the workflow: a measuring session, and a whole cell."""
