from magloc.live.follower import Follower as Follower
from magloc.live.follower import LivePoint as LivePoint
from magloc.live.follower import track as track
from magloc.live.tally import Tally as Tally
