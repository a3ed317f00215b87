"""The parts of algorithms: base class, replay buffers, networks, inspection, checks."""
