//! Typed outputs and inputs of stages.
use std::any::Any;
use std::marker::PhantomData;
use std::sync::Arc;

/// Output of any type, as graphs pass it on.
pub(super) type Value = Arc<dyn Any + Send + Sync>;

/// Handle of the output of a stage in a graph.
pub struct Output<T> {
    pub(super) node: usize,
    pub(super) made: PhantomData<fn() -> T>,
}

impl<T> Clone for Output<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Output<T> {}

/// Tuples of [`Output`]s.
pub trait Inputs {
    /// References to the outputs.
    type Values<'v>;
    /// Indices of the stages that make them.
    fn nodes(&self) -> Vec<usize>;
    /// Outputs in the order of [`Inputs::nodes`]; `None` if a type does not match.
    fn values(made: &[Value]) -> Option<Self::Values<'_>>;
}

macro_rules! inputs {
    ($($name:ident $at:tt),*) => {
        impl<$($name: Send + Sync + 'static),*> Inputs for ($(Output<$name>,)*) {
            type Values<'v> = ($(&'v $name,)*);
            fn nodes(&self) -> Vec<usize> {
                vec![$(self.$at.node),*]
            }
            fn values(_made: &[Value]) -> Option<Self::Values<'_>> {
                Some(($(_made.get($at)?.downcast_ref::<$name>()?,)*))
            }
        }
    };
}

inputs!();
inputs!(A 0);
inputs!(A 0, B 1);
inputs!(A 0, B 1, C 2);
inputs!(A 0, B 1, C 2, D 3);

impl<T> Output<T> {
    /// Target for [`super::Graph::run`].
    pub fn target(self) -> usize {
        self.node
    }
}
