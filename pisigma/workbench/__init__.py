"""Pages in the browser over the workflow: a measuring session, and a whole cell."""
