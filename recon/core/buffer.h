// Memory that is kept from one call to the next: aligned to cache lines and not initialised.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>

namespace core {

template <class T>
class Buffer {
public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { std::free(data_); }

    // Room for `size` items. What was stored before is lost when the buffer has to grow.
    T* resize(size_t size) {
        if (size > capacity_) {
            std::free(data_);
            capacity_ = 0;
            const size_t wanted = size + size / 4 + 64;
            const size_t bytes = (wanted * sizeof(T) + 63) / 64 * 64;
            data_ = static_cast<T*>(std::aligned_alloc(64, bytes));
            if (!data_) throw std::bad_alloc();
            capacity_ = wanted;
        }
        return data_;
    }

    T* data() { return data_; }
    const T* data() const { return data_; }
    T& operator[](size_t index) { return data_[index]; }
    const T& operator[](size_t index) const { return data_[index]; }

private:
    T* data_ = nullptr;
    size_t capacity_ = 0;
};

}  // namespace core
