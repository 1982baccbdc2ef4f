//! The interface of an instruction set: it computes one tile of a product in registers.
//! This module names no instruction set; `dispatch` chooses one.

pub(crate) use super::element::LANES;
use super::element::{Element, Rounding};

/// What a product does with the old content of the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// out = a b
    Replace,
    /// out = out + a b, row after row, so that rows of the output may overlap. If they do not, an instruction
    /// set may start its accumulators from `out`.
    Add,
}

/// A tile in the form that instruction sets take.
///
/// `left` may be read at row * row_stride + run * run_stride + i * step_stride, i < steps, for every row and run, `DEPTH` scalars each.
/// `panel` holds runs * steps * vecs * LANES * DEPTH scalars. `out` may be read and written at row * out_stride, `cols` scalars each.
pub(crate) struct RawTile<E> {
    pub(super) left: *const E,
    pub(super) row_stride: usize,
    pub(super) step_stride: usize,
    pub(super) steps: usize,
    pub(super) run_stride: usize,
    pub(super) runs: usize,
    pub(super) panel: *const E,
    pub(super) out: *mut f32,
    pub(super) out_stride: usize,
    pub(super) cols: usize,
    pub(super) mode: Mode,
}

impl<E> RawTile<E> {
    /// How many rows read each step of a run: 2 or 3 if the rows are windows that overlap by a half or by two thirds, else 1.
    pub(super) fn taps(&self) -> usize {
        let run = self.steps * self.step_stride;
        // Not `row_stride * taps`: the stride of a single row is any number, and the product may wrap.
        let fits = |taps: &usize| self.steps.is_multiple_of(*taps) && self.row_stride == run / taps;
        [2, 3].into_iter().find(fits).unwrap_or(1)
    }
}

/// An instruction set, with the type in which it stores operands. Sums are f32.
///
/// A value exists only if the processor has the instructions: `new` checks that first.
pub(crate) trait Simd: Rounding + Send + Sync + 'static {
    type Element: Element;

    /// Largest width of a tile, in registers of columns.
    const VECS_MAX: usize;

    /// Steps of a panel that all rows of a task are multiplied by before the next steps: 32 KiB of the widest panel.
    const STEPS_IN_CACHE: usize = 128;

    /// Whether a left operand's steps should be adjacent, and its rows begin on cache lines, even if packing
    /// has to transpose the operand.
    const LEFT_STEPS_ADJACENT: bool = false;

    /// Largest number of rows of a tile that is `vecs` registers wide.
    fn rows_max(vecs: usize) -> usize;

    /// Computes a tile of `rows` by `vecs` registers.
    ///
    /// # Safety
    /// `tile` fulfils the conditions of [`RawTile`]; `rows` and `vecs` are within the limits above.
    #[allow(unsafe_code, reason = "implemented with the processor's instructions")]
    unsafe fn compute(self, tile: &RawTile<Self::Element>, rows: usize, vecs: usize);

    /// Transposes a block of steps, [column, step] to [step, column].
    #[inline(always)]
    fn transpose(self, block: &mut [[u32; LANES]; LANES]) {
        let transposed: [[u32; LANES]; LANES] =
            std::array::from_fn(|step| std::array::from_fn(|column| block[column][step]));
        *block = transposed;
    }

    /// Runs `work`, compiled for these instructions, so that its loops use the vector registers.
    fn vectorize<W: Loop>(self, work: W);
}

/// Loops over slices, made by `vectorized!`.
pub(crate) trait Loop {
    /// Runs the loops. Must be `#[inline(always)]`, because a separate function or a closure is compiled without the extensions.
    fn run(self);
}

/// Defines functions whose bodies are compiled for the instruction set in their first argument.
///
/// `fn name<S>(simd, argument: &'a [S::Element], ..) { .. }`; further type parameters are elements, and references have the lifetime `'a`.
macro_rules! vectorized {
    ($(
        $(#[$meta:meta])*
        $vis:vis fn $name:ident<$S:ident $(, $E:ident)*>($simd:ident $(, $arg:ident: $ty:ty)* $(,)?) $body:block
    )+) => {$(
        $(#[$meta])*
        $vis fn $name<'a, $S: $crate::kernels::isa::simd::Simd $(, $E: $crate::kernels::isa::element::Element)*>(
            $simd: $S
            $(, $arg: $ty)*
        ) {
            struct Work<'a, $S: $crate::kernels::isa::simd::Simd $(, $E: $crate::kernels::isa::element::Element)*>(
                $S,
                $($ty,)*
                std::marker::PhantomData<(&'a (), $($E,)*)>,
            );
            impl<'a, $S: $crate::kernels::isa::simd::Simd $(, $E: $crate::kernels::isa::element::Element)*>
                $crate::kernels::isa::simd::Loop for Work<'a, $S $(, $E)*>
            {
                #[inline(always)]
                #[allow(unused_variables, reason = "few loops need the value itself")]
                fn run(self) {
                    let Self($simd, $($arg,)* _) = self;
                    $body
                }
            }
            $simd.vectorize(Work::<$S $(, $E)*>($simd, $($arg,)* std::marker::PhantomData));
        }
    )+};
}
pub(crate) use vectorized;

/// Calls `function::<N>(first, ..)` for blocks of `N` channels: whole registers, then half a register, then single channels.
macro_rules! each_block {
    ($channels:expr, $function:ident($($argument:expr),*)) => {{
        const HALF: usize = $crate::kernels::isa::simd::LANES / 2;
        let channels: usize = $channels;
        let [whole, half] = [2 * HALF, HALF].map(|len| channels - channels % len);
        for first in (0..whole).step_by(2 * HALF) {
            $function::<{ 2 * HALF }>(first, $($argument),*);
        }
        for first in (whole..half).step_by(HALF) {
            $function::<HALF>(first, $($argument),*);
        }
        for first in half..channels {
            $function::<1>(first, $($argument),*);
        }
    }};
}
pub(crate) use each_block;
