"""Engines that run the same work for many items: in processes of this machine, or on a cluster."""
