//! The engine's C interface (libenv version 1), type for type.
//! Nothing here is safe to use by itself; `vec_game` keeps the rules of the calls.
//!
//! Source: `gym3/libenv.h` of gym3 0.3.3 and `procgen/src/vecgame.cpp` of procgen 0.10.7.

use std::ffi::{c_char, c_void};
use std::mem::{offset_of, size_of};

pub(crate) const NAME_BYTES: usize = 128;
pub(crate) const DIMENSIONS_MAX: usize = 16;
pub(crate) const LIBENV_VERSION: i32 = 1;

pub(crate) const DTYPE_UINT8: u32 = 1;
pub(crate) const DTYPE_INT32: u32 = 2;

pub(crate) const SPACE_OBSERVATION: u32 = 1;
pub(crate) const SPACE_ACTION: u32 = 2;
pub(crate) const SPACE_INFO: u32 = 3;

/// One tensor of a space. The engine leaves the bytes after the name's NUL and the shape past `ndim` unset.
#[repr(C)]
#[derive(Clone, Copy)]
pub(crate) struct LibenvTensortype {
    pub(crate) name: [c_char; NAME_BYTES],
    pub(crate) scalar_type: u32,
    pub(crate) dtype: u32,
    pub(crate) shape: [i32; DIMENSIONS_MAX],
    pub(crate) ndim: i32,
    /// The bounds of the values: unions of the type that `dtype` names; nothing here reads them.
    pub(crate) low: u32,
    pub(crate) high: u32,
}

/// One setting: `count` values of `dtype` at `data`.
#[repr(C)]
pub(crate) struct LibenvOption {
    pub(crate) name: [c_char; NAME_BYTES],
    pub(crate) dtype: u32,
    pub(crate) count: i32,
    pub(crate) data: *mut c_void,
}

/// The settings; passed by value.
#[repr(C)]
pub(crate) struct LibenvOptions {
    pub(crate) items: *mut LibenvOption,
    pub(crate) count: i32,
}

/// The buffers that the engine reads and writes. Pointer arrays are indexed by `tensor * num_envs + env`.
#[repr(C)]
pub(crate) struct LibenvBuffers {
    pub(crate) ob: *mut *mut c_void,
    pub(crate) rew: *mut f32,
    pub(crate) first: *mut u8,
    pub(crate) info: *mut *mut c_void,
    pub(crate) ac: *mut *mut c_void,
}

const _: () = {
    assert!(size_of::<LibenvTensortype>() == 212);
    assert!(offset_of!(LibenvTensortype, scalar_type) == 128);
    assert!(offset_of!(LibenvTensortype, dtype) == 132);
    assert!(offset_of!(LibenvTensortype, shape) == 136);
    assert!(offset_of!(LibenvTensortype, ndim) == 200);
    assert!(offset_of!(LibenvTensortype, low) == 204);
    assert!(offset_of!(LibenvTensortype, high) == 208);
    assert!(size_of::<LibenvOption>() == 144);
    assert!(offset_of!(LibenvOption, dtype) == 128);
    assert!(offset_of!(LibenvOption, count) == 132);
    assert!(offset_of!(LibenvOption, data) == 136);
    assert!(size_of::<LibenvOptions>() == 16);
    assert!(offset_of!(LibenvOptions, count) == 8);
    assert!(size_of::<LibenvBuffers>() == 40);
    assert!(offset_of!(LibenvBuffers, info) == 24);
};

pub(crate) type Handle = *mut c_void;
pub(crate) type VersionFn = unsafe extern "C-unwind" fn() -> i32;
pub(crate) type MakeFn = unsafe extern "C-unwind" fn(i32, LibenvOptions) -> Handle;
pub(crate) type GetTensortypes =
    unsafe extern "C-unwind" fn(Handle, u32, *mut LibenvTensortype) -> i32;
pub(crate) type SetBuffers = unsafe extern "C-unwind" fn(Handle, *mut LibenvBuffers);
pub(crate) type HandleFn = unsafe extern "C-unwind" fn(Handle);
pub(crate) type GetState = unsafe extern "C-unwind" fn(Handle, i32, *mut c_char, i32) -> i32;
pub(crate) type SetState = unsafe extern "C-unwind" fn(Handle, i32, *mut c_char, i32);

/// A name in the engine's fixed, NUL-terminated form. Panics on names that do not fit; ours are constants.
pub(crate) fn option_name(text: &str) -> [c_char; NAME_BYTES] {
    assert!(
        text.len() < NAME_BYTES && text.is_ascii(),
        "\"{text}\" does not fit in an option's name"
    );
    let mut name = [0; NAME_BYTES];
    for (to, from) in name.iter_mut().zip(text.bytes()) {
        *to = from as c_char;
    }
    name
}

impl LibenvTensortype {
    /// An all-zero value for the engine to write over.
    pub(crate) const fn zeroed() -> LibenvTensortype {
        LibenvTensortype {
            name: [0; NAME_BYTES],
            scalar_type: 0,
            dtype: 0,
            shape: [0; DIMENSIONS_MAX],
            ndim: 0,
            low: 0,
            high: 0,
        }
    }

    /// Returns the tensor's name, dtype and shape in the form of [`describe_tensor`].
    pub(crate) fn describe(&self) -> String {
        let bytes: Vec<u8> = self.name.iter().map(|&byte| byte as u8).collect();
        let name = bytes.split(|&byte| byte == 0).next().unwrap_or_default();
        let ndim = usize::try_from(self.ndim).unwrap_or(0).min(DIMENSIONS_MAX);
        describe_tensor(
            &String::from_utf8_lossy(name),
            self.dtype,
            &self.shape[..ndim],
        )
    }
}

pub(crate) fn describe_tensor(name: &str, dtype: u32, shape: &[i32]) -> String {
    format!("{name} (dtype {dtype}) {shape:?}")
}
