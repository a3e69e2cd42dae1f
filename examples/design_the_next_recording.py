"""My recording cannot tell play in the drives from friction on the guides. Which commands would?"""
