// The extension module; docs/core.md describes it.
#include "binding.hpp"
#include "window.hpp"

using namespace teamslam;

NB_MODULE(TEAMSLAM_MODULE, m) {
  nb::set_leak_warnings(false);  // caches in Python hold objects until the interpreter ends
  m.doc() = "The numerical core: the state of a window, and functions with defined bits.";
  m.attr("level") = TEAMSLAM_LEVEL;
  m.attr("digest") = TEAMSLAM_DIGEST;
  m.attr("width") = pack::WIDTH;
  m.attr("POSE_JITTER") = nb::make_tuple(window::POSE_JITTER[0], window::POSE_JITTER[1], window::POSE_JITTER[2]);
  nb::exception<binding::NotFiniteError>(m, "NotFiniteError", PyExc_ValueError);
  nb::exception<window::MotionError>(m, "MotionError", PyExc_ValueError);
  binding::bind_checks(m);
  binding::bind_consensus(m);
  binding::bind_dense(m);
  binding::bind_elementary(m);
  binding::bind_graph(m);
  binding::bind_maps(m);
  binding::bind_models(m);
  binding::bind_motion(m);
  binding::bind_se2(m);
  binding::bind_sparse(m);
  binding::bind_random(m);
  binding::bind_window(m);
  binding::bind_segmenter(m);
}
