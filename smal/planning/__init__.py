"""Planning: the route along the taught ways, the behaviours, and the planner that decides by them."""

from smal.planning.behaviours import Said as Said
from smal.planning.cost_to_go import cost_to_go as cost_to_go
from smal.planning.planner import Decision as Decision
from smal.planning.planner import Planner as Planner
