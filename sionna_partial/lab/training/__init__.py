"""Training of networks, the path model, and unseen walls."""
