"""What there is to see of a mission: one description, and pictures made of it.

`scene` describes it. The page, the record's scene for viewers, drawings and the environments' render all
show what it describes; none of them knows the bus.

Imports: plume.
"""
