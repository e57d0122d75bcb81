"""A peer: a node that keeps the team's set of submaps and folds it by itself, as the centre does.

    PeerShell, CentreShell            process: bus, clock, file of the set    main.py
      │ handle_sample, tick, answer          ▲ messages to publish
      ▼                                      │
    PeerRobot, PeerCentre             router: no state of the map             robot.py, centre.py
      │ on Peer                                                               peer.py
      ├──> RobotNode                  the estimator; a centre has none        team/robot
      ├──> PeerNode                   the set, and requests between peers     team/peers
      └──> PeerFold ──> CentralNode   the fold: attendance, maps, priors      fold.py, central

Calls go down only, and messages are returned. A measurement goes to the estimator; its submap goes
into the set and out to the others; the fold reads the new members of the set and gives them to its
own centre's node; the map goes out under the peer's name, and the prior goes to the estimator for
`team/pose`. The three nodes are independent of each other, except that the fold reads the set.
"""
