"""Diesel in the units people report; the code itself counts kilograms and joules."""

DENSITY_KG_PER_L = 0.8375
"""Diesel density that the paper's rows fit together with a heating value of 42.8 MJ/kg. One value
for every powertrain: the 0.838 kg/L of the field data is 0.06 % more, and fuel is compared by
mass."""

L_PER_US_GALLON = 3.785411784


def litres(fuel_kg: float) -> float:
    """Litres of ``fuel_kg`` of diesel."""
    return fuel_kg / DENSITY_KG_PER_L


def gallons(fuel_kg: float) -> float:
    """US gallons of ``fuel_kg`` of diesel."""
    return litres(fuel_kg) / L_PER_US_GALLON
