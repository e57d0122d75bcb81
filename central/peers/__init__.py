"""A peer: a node that keeps the team's set of submaps and folds it by itself, as the centre does.

    PeerShell, CentreShell            process: bus, clock, file of the set    main.py
      │ handle_sample, tick, answer          ▲ messages to publish
      ▼                                      │
    PeerRobot, PeerCentre             router: no state of the map             robot.py, main.py
      │ on Peer                                                               peer.py
      ├──> RobotNode                  the estimator; a centre has none        team/robot
      ├──> PeerNode                   the set, and requests between peers     team/peers
      └──> PeerFold ──> CentralNode   the fold: attendance, maps, priors      fold.py, central

Calls go down only, and messages are returned. The estimator's submaps enter the set and are
published; the fold reads the set's new members; its map is published under the peer's name, and the
estimator uses its prior for `team/pose`. The three nodes are otherwise independent.
"""
