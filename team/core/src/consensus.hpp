// Which measurements of a window agree; measurements that no others confirm are outliers.
//
// A measurement is good with probability 1 − ε and has the sensor's noise or the covariance that it
// brings, or it is an outlier, uniform over the sensor's range and field of view with density u. It is
// accepted if (1 − ε) p(z | the other accepted ones, odometry) > ε u. A landmark is accepted if its
// measurements together reach odds of EVIDENCE against being outliers and against being another
// landmark of the window under a wrong identity. The only measurement of a landmark is accepted: it does
// not affect the path, and is compared with other windows at the centre. Only measurements of the window itself are used: a gate
// by a map or an earlier window would keep rejecting correct measurements once that map is wrong, and
// would use measurements twice. All variances of a measurement are its whole ones, since the persistent
// part of its error is nearly constant within a window.
#pragma once

#include <map>

#include "arrow.hpp"
#include "motion.hpp"
#include "window.hpp"

namespace teamslam::window {

class Consensus {
 public:
  // share: ε, in (0, 1).
  Consensus(const Noise& sensor, double max_range, double field_of_view, double share);

  // Adds a keyframe: the motion since the last one, and its measurements, of which there may be none.
  void add(const motion::Increment& motion, const Scan& scan);

  std::size_t size() const { return measurements_.size(); }

  // Accepts the measurements since the last call that are in `agreeing`. If one that was accepted before no
  // longer agrees, all are classified anew. Returns whether all that were accepted before still are.
  bool accept();

  // Accepts the measurements in `confirmed`; returns whether the classification changed.
  bool confirm();

  const std::vector<bool>& accepted() const { return accepted_; }

  // Marks each measurement that agrees with others of its landmark under the odometry alone.
  //
  // The measurement of a landmark that the others support best places it; it is accepted together with
  // those that support it. Measurement j supports i with max(0, log p(j | i, odometry) + odds of j).
  // Only the first MOST_COMPARED measurements of a landmark can place it.
  std::vector<bool> agreeing() const;

  // As `agreeing`, then by a smoother over the whole window until the classification is stable.
  //
  // The smoother estimates poses and landmarks by least squares over the odometry and the accepted
  // measurements; then every measurement is compared with its prediction from the others. Where the
  // normal equations have no solution in floating point or the window has more than MOST_SMOOTHED
  // scans, nothing more is rejected. Where more than a twentieth of the measurements that others could
  // confirm are rejected, ε is that share, at most ½, in a second pass, which rejects the only
  // measurement of a landmark too.
  std::vector<bool> confirmed() const;

 private:
  struct Measurement {
    std::size_t scan;
    Reading reading;
    models::Landmark<double> placed;  // seen from its own scan
  };
  // The measurements of one landmark; logs[i][j]: log p(j | i, odometry), 0 of one by itself, for the
  // first MOST_COMPARED i.
  struct Landmark {
    std::vector<std::size_t> measurements;
    std::vector<std::vector<double>> logs;
  };
  // The measurement that places a landmark, an index among its own, and its support.
  struct Support {
    std::size_t best = 0;
    double total = -1.0;
  };
  struct Smoothed;

  double odds() const;
  std::vector<bool> confirmed_by_others() const;
  Support support_of(const Landmark& landmark, double odds) const;
  Smoothed started() const;
  bool smooth(Smoothed& window, const std::vector<bool>& taken) const;
  std::vector<double> logs_of_others(const Smoothed& window, const std::vector<bool>& taken) const;
  std::vector<bool> judged(const Smoothed& window, std::span<const double> logs, const std::vector<bool>& before) const;
  std::vector<bool> misread(const Smoothed& window, std::span<const double> logs, const std::vector<bool>& taken) const;

  Noise sensor_;
  double max_range_, field_of_view_;
  double prior_;           // log odds that a measurement is good
  bool accepts_lone_ = true;  // whether the only measurement of a landmark is accepted
  double farthest_ = 0.0;  // the largest range so far [m]
  motion::Increment since_;                 // since the last scan
  std::vector<motion::Increment> motions_;  // between the scans, the first one zero
  std::vector<motion::Increment> to_last_;  // from each scan to the last one
  std::vector<Measurement> measurements_;
  std::map<std::uint32_t, Landmark> landmarks_;
  std::vector<bool> accepted_;
};

}  // namespace teamslam::window
