// Bindings of the random numbers and of digests.
#include "binding.hpp"
#include "blake2b.hpp"
#include "random.hpp"

namespace teamslam::binding {

using blake2b::Hash, blake2b::word_of, random::Random;

namespace {

constexpr std::size_t MOST_NUMBERS = std::size_t(1) << 30;

std::span<const char> span_of(const nb::bytes& data) { return {data.c_str(), data.size()}; }

Hash made_hash(std::size_t size, const nb::bytes& person) {
  check(size > 0 && size <= Hash::MOST, "digest_size must be in 1 ... 64");
  check(person.size() <= Hash::PERSON, "person must be of at most 16 bytes");
  return {size, span_of(person)};
}

nb::bytes digest_of(const Hash& hash) { return nb::bytes(hash.digest().data(), hash.size()); }

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

  nb::class_<Hash>(m, "Blake2b", "An incremental BLAKE2b digest (RFC 7693) without a key.")
      .def(
          "__init__", [](Hash* self, std::size_t digest_size, const nb::bytes& person) { new (self) Hash(made_hash(digest_size, person)); },
          "digest_size"_a, "person"_a = nb::bytes("", 0), "person: at most 16 bytes, which separate uses.")
      .def("update", [](Hash& self, const nb::bytes& data) { self.update(span_of(data)); }, "data"_a, "Add bytes.")
      .def("copy", [](const Hash& self) { return self; }, "Return an independent copy.")
      .def("digest", &digest_of, "Return the digest of all bytes so far.");
  m.def(
      "blake2b",
      [](const nb::bytes& data, std::size_t digest_size, const nb::bytes& person) {
        Hash hash = made_hash(digest_size, person);
        hash.update(span_of(data));
        return digest_of(hash);
      },
      "data"_a, "digest_size"_a, "person"_a = nb::bytes("", 0), "Compute a BLAKE2b digest (RFC 7693); arguments as of `Blake2b`.");
}

}  // namespace teamslam::binding
