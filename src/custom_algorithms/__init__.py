"""Your algorithms: one file each, with a YAML of the same name in conf/algorithm/."""
