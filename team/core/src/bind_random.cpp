// Bindings of the random numbers.
#include "binding.hpp"
#include "random.hpp"

namespace teamslam::binding {

using random::Random;

namespace {

constexpr std::size_t MOST_NUMBERS = std::size_t(1) << 30;

std::uint64_t word_of(const char* bytes) {
  std::uint64_t word = 0;
  for (int i = 7; i >= 0; i--) word = word << 8 | static_cast<unsigned char>(bytes[i]);
  return word;
}

}  // namespace

void bind_random(nb::module_& m) {
  nb::class_<Random>(m, "Random",
                     "Random numbers with defined bits: Philox 4x64-10 (Salmon et al. 2011), a function of its key and\n"
                     "of the count of numbers drawn before.")
      .def(
          "__init__",
          [](Random* self, const nb::bytes& key) {
            check(key.size() == 16, "the key must be 16 bytes");
            new (self) Random({word_of(key.c_str()), word_of(key.c_str() + 8)});
          },
          "key"_a, "Begin at the first number of a key of 16 bytes.")
      .def("uniform", &Random::uniform, "Draw a number in [0, 1).")
      .def(
          "normals",
          [](Random& self, std::size_t rows, std::size_t columns) {
            check(columns == 0 || rows <= MOST_NUMBERS / columns, "at most 2^30 numbers");
            return made<double, nb::ndim<2>>(self.normals(rows * columns), {rows, columns});
          },
          "rows"_a, "columns"_a, "Draw standard normal numbers (rows, columns) (Box and Muller 1958).");
}

}  // namespace teamslam::binding
