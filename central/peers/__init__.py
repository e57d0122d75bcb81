"""A peer: a node that keeps the team's set of submaps and folds it as the centre does.

    PeerShell, CentreShell            process: bus, clock, file of the set    main.py
      │ handle_sample, tick, answer          ▲ messages to publish
      ▼                                      │
    PeerRobot, PeerCentre             router: no state of the map             robot.py, main.py
      │ on Peer                                                               peer.py
      ├──> RobotNode                  the estimator; a centre has none        team/robot
      ├──> PeerNode                   the set, and requests between peers     team/peers
      └──> PeerFold ──> CentralNode   the fold: attendance, maps, priors      fold.py, central

Calls go down only, and messages are returned.
"""
