"""Engines that run a function for many items, in processes of this machine or on a cluster."""
