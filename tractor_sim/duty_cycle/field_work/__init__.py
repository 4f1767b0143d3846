"""Power demand of field, yard and road work from the physics of implement, wheel and ground."""
