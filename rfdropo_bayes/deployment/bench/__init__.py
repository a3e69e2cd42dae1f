"""Drives without motors: simulated drives on a hub, what they pull on, and a simulation of the whole bus."""
