"""Drives without motors: simulated drives on a hub, the plant that they pull on, and a simulation of the whole bus."""
