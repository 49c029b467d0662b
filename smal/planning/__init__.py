"""What to do: the cost to go over the taught ways, and who plans by it."""

from smal.planning.cost_to_go import chosen_goal as chosen_goal
from smal.planning.cost_to_go import cost_to_go as cost_to_go
from smal.planning.planner import Decision as Decision
from smal.planning.planner import Planner as Planner
from smal.planning.planner import Said as Said
