"""Where work for many items is done: in processes of this machine, or on a cluster."""
